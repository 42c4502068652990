"""Tests of the order in which the daemon ends its parts."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import Instant, Received
from acsard.daemon.daemon import Departure, _control, _recorder
from acsard.daemon.pulse import Pulse
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
