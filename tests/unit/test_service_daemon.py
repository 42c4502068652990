"""The daemon ends its parts in order, and restarts the programs that it started."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
import threading
from contextlib import AsyncExitStack
from pathlib import Path

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


async def first_event(kind: Kind = GATEWAY) -> Event:
    """Return the first event of the supervisor."""
    queue: asyncio.Queue[Event] = asyncio.Queue()
    keeper = asyncio.create_task(keep_running(["gateway"], queue.put_nowait, kind))
    first = asyncio.create_task(queue.get())
    await asyncio.wait({keeper, first}, return_when=asyncio.FIRST_COMPLETED, timeout=10.0)
    assert not keeper.done(), keeper
    keeper.cancel()
    return await first


def test_a_program_that_cannot_be_started_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    event = asyncio.run(first_event())
    assert (event.name, event.level) == ("gateway_ended", "warning")


def test_a_thread_that_cannot_be_started_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", full)
    assert asyncio.run(first_event()).name == "gateway_ended"


def program(monkeypatch: pytest.MonkeyPatch, where: Path, text: str) -> None:
    """Replace the `acsard` program by a script with this text."""
    file = where / "program"
    file.write_text(f"#!{sys.executable} -S\n{text}\n")
    file.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(file))


def test_a_program_that_falls_silent_is_killed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("acsard.host.child.SILENCE_TIMEOUT_NS", 0)
    pid = tmp_path / "pid"
    stops = f"import os; os.write(0, b'.'); open({str(pid)!r}, 'w').write(str(os.getpid())); "
    program(monkeypatch, tmp_path, stops + "os.kill(os.getpid(), 19)")
    assert asyncio.run(first_event()).name == "gateway_ended"
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), signal.SIGCONT)


@pytest.mark.parametrize(("kind", "code"), [(PAGE, 2), (PAGE, 75), (PAGE, 77), (PAGE, 78)])
def test_a_program_that_cannot_start_at_first_is_given_up(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: Kind, code: int
) -> None:
    program(monkeypatch, tmp_path, f"raise SystemExit({code})")
    events: list[Event] = []
    assert asyncio.run(keep_running(["any"], events.append, kind)) == code
    (event,) = events
    assert (event.name, event.level) == (kind.ended, "warning")
    assert kind.remedy in event.text


@pytest.mark.parametrize(("kind", "code"), [(PAGE, 2), (PAGE, 77), (PAGE, 78)])
def test_a_program_that_once_ran_is_started_again_when_its_files_are_wrong(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: Kind, code: int
) -> None:
    monkeypatch.setattr("acsard.daemon.supervisor.LONG_RESTART_PAUSE_S", 0.01)
    kind = replace(kind, restart_pause_s=0.01)
    began = tmp_path / "began"
    ends = f"import os; p = {str(began)!r}; new = not os.path.exists(p); open(p, 'a').close(); "
    program(monkeypatch, tmp_path, ends + f"raise SystemExit(1 if new else {code})")
    events: list[Event] = []

    async def runs() -> None:
        keeper = asyncio.create_task(keep_running(["any"], events.append, kind))
        while len(events) < 3 and not keeper.done():
            await asyncio.sleep(0.01)
        assert not keeper.done()
        keeper.cancel()

    asyncio.run(asyncio.wait_for(runs(), 10.0))
    assert {event.name for event in events} == {kind.ended}


def test_a_page_that_a_person_ends_after_it_ran_stays_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    began = tmp_path / "began"
    ends = f"import os; p = {str(began)!r}; new = not os.path.exists(p); open(p, 'a').close(); "
    program(monkeypatch, tmp_path, ends + "raise SystemExit(1 if new else 0)")
    events: list[Event] = []
    page = replace(PAGE, restart_pause_s=0.01)
    assert asyncio.run(keep_running(["web"], events.append, page)) == 0
    assert [PAGE.remedy in event.text for event in events] == [False, True]


def test_the_first_page_that_could_be_started_counts_as_the_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """If the system refuses to start the process, this says nothing about the page's files."""
    monkeypatch.setattr("acsard.daemon.supervisor.LONG_RESTART_PAUSE_S", 0.01)
    program(monkeypatch, tmp_path, "raise SystemExit(78)")
    executable = sys.executable
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    events: list[Event] = []

    def log(event: Event) -> None:
        events.append(event)
        monkeypatch.setattr(sys, "executable", executable)

    assert asyncio.run(keep_running(["web"], log, PAGE)) == 78
    assert [PAGE.remedy in event.text for event in events] == [False, True]


@pytest.mark.parametrize(("kind", "code"), [(GATEWAY, 78), (PAGE, 1)])
def test_a_program_that_may_start_later_is_restarted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: Kind, code: int
) -> None:
    program(monkeypatch, tmp_path, f"raise SystemExit({code})")
    event = asyncio.run(first_event(kind))
    assert event.name == kind.ended
