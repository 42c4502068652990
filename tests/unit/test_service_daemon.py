"""The daemon ends its parts in order, and restarts the programs that it started."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import Event, Instant, Received
from acsard.daemon.daemon import Departure, _control, _recorder
from acsard.daemon.pulse import Pulse
from acsard.daemon.supervisor import GATEWAY, PAGE, Kind, keep_running
from acsard.host.logs import Log
from acsard.host.systemd import Systemd
from acsard.recording import recorder
from acsard.recording.file import Failure, Recording
from tests.each import each
from tests.scenarios.world import World


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (
            ExceptionGroup("of tasks", [ValueError("a fault of our own")]),
            "ValueError: a fault of our own",
        ),
        (asyncio.CancelledError(), ""),
    ],
)
def test_the_recording_ends_with_the_error_of_the_daemon_and_the_error_is_raised(
    error: BaseException, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "CLOSE_S", 20.0)
    config = replace(Config(), record=RecordConfig(str(tmp_path)))

    async def run() -> None:
        async with AsyncExitStack() as stack:
            World(config, recorder=_recorder(config, lambda event: None, 0, stack)).run(0.5)
            raise error

    with pytest.raises(type(error)) as raised:
        asyncio.run(run())
    assert why == "" or raised.value is error
    (path,) = tmp_path.iterdir()
    *_, last = Recording([path]).records()
    assert (last.why if isinstance(last, Failure) else "") == why


def test_systemd_receives_stopping_before_the_daemon_cleans_up_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After STOPPING=1 systemd no longer checks its watchdog.

    Otherwise a timeout of the watchdog could hide the error.
    """
    world = World()

    def broken(late: Instant | None = None) -> tuple[Received, ...]:
        raise ValueError("a fault of our own")

    monkeypatch.setattr(world.port, "take", broken)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service_manager:
        service_manager.bind(str(tmp_path / "notify"))
        service_manager.setblocking(False)

        async def run() -> None:
            pulse = Pulse()
            manager = Systemd({"NOTIFY_SOCKET": str(tmp_path / "notify")}, os.getpid())
            departure = Departure(Log(world.config.log), pulse, manager)
            with pytest.raises(ValueError, match="a fault of our own"):
                await _control(world.config, world.loop, departure, pulse, manager)
            manager.close()

        asyncio.run(run())
        lines = service_manager.recv(4096).decode().splitlines()
        assert "STOPPING=1" in lines
        assert service_manager.recv(4096).decode() == "STATUS=ending after an error in the daemon"


async def first_event() -> Event:
    """Return the first event of the supervisor."""
    queue: asyncio.Queue[Event] = asyncio.Queue()
    keeper = asyncio.create_task(keep_running(["gateway"], queue.put_nowait, GATEWAY))
    first = asyncio.create_task(queue.get())
    await asyncio.wait({keeper, first}, return_when=asyncio.FIRST_COMPLETED, timeout=10.0)
    assert not keeper.done(), keeper
    keeper.cancel()
    return await first


def test_a_program_that_cannot_be_started_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    event = asyncio.run(first_event())
    assert (event.name, event.level) == ("gateway_ended", "warning")


def program(monkeypatch: pytest.MonkeyPatch, where: Path, text: str) -> None:
    """Replace the `acsard` program by a script with this text."""
    file = where / "program"
    file.write_text(f"#!{sys.executable} -S\n{text}\n")
    file.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(file))


def test_a_silent_program_is_killed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("acsard.host.child.SILENCE_TIMEOUT_NS", 0)
    pid = tmp_path / "pid"
    stops = f"import os; os.write(0, b'.'); open({str(pid)!r}, 'w').write(str(os.getpid())); "
    program(monkeypatch, tmp_path, stops + "os.kill(os.getpid(), 19)")
    assert asyncio.run(first_event()).name == "gateway_ended"
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), signal.SIGCONT)


@each(
    ("kind", "codes", "result"),
    [
        *((PAGE, (code,), code) for code in (2, 75, 77, 78)),  # it cannot start
        (PAGE, (1, 0), 0),  # a person ended it
        *((PAGE, (1, code), None) for code in (2, 77, 78)),  # it ran, so its files may be mended
        (PAGE, (1,), None),
        (GATEWAY, (78,), None),
    ],
)
def test_a_program_is_started_again_unless_it_never_ran_or_a_person_ended_it(
    kind: Kind, codes: tuple[int, ...], result: int | None
) -> None:
    """The program ends with these exit codes, and with the last one again and again."""
    events: list[Event] = []

    async def run() -> int | None:
        keeper = asyncio.create_task(keep_running(["any"], events.append, kind))
        async with asyncio.timeout(10.0):
            while len(events) < 3 and not keeper.done():
                await asyncio.sleep(0.01)
        if keeper.done():
            return keeper.result()
        keeper.cancel()
        return None

    kind = replace(kind, restart_pause_s=0.01)
    with pytest.MonkeyPatch.context() as patched, TemporaryDirectory() as where:
        patched.setattr("acsard.daemon.supervisor.LONG_RESTART_PAUSE_S", 0.01)
        ends = f"import os; p = {where!r} + '/runs'; open(p, 'a').write('.'); "
        ends += f"codes = {codes}; raise SystemExit(codes[min(os.stat(p).st_size, len(codes)) - 1])"
        program(patched, Path(where), ends)
        assert asyncio.run(run()) == result
    assert {(event.name, event.level) for event in events} == {(kind.ended, "warning")}
    told = [f"it is not restarted: {kind.remedy}" in event.text for event in events]
    assert told == [False] * (len(events) - 1) + [result is not None]
