"""The checked link with the real daemon on a pty of the simulator, in real time."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from acsard.client import Client, NotDrivenError, connect
from tests.system.bystander import lost
from tests.system.harness import Bus, Daemon, until


def drives(robot: Client) -> float:
    """Drive at 0.5 m/s for 0.5 s, and return the x at the start in m.

    Repeats the drive if a busy machine interrupted the link.
    """
    while True:
        begun, x = time.monotonic(), robot.pose().x
        try:
            robot.drive(0.5, seconds=0.5)
            return x
        except NotDrivenError:
            assert lost(begun) > 0.1


@pytest.mark.slow
def test_the_daemon_drives_checked_with_samples_and_leaves_with_a_stop(tmp_path: Path) -> None:
    config = {"mcu": {"port": "sim", "link_check": "on", "encoder_counts": 3200}}
    started = time.monotonic()
    with Daemon(tmp_path, config=config) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up", 5.0, "link up")
        assert daemon.events("link_check") == []
        with connect(daemon.endpoint) as robot:
            began = time.monotonic()
            before = drives(robot)
            until(lambda: robot.get("state").linear == 0.0, 3.0, "at rest")
            distance = robot.pose().x - before
            assert distance == pytest.approx(0.25, abs=0.05 + 0.5 * lost(began))

        # A line that waited for a core for longer than the next two took answers an old one.
        late = {"line_stale_sequence"} if lost(started) > 0.02 else set()
        if late and daemon.events("link_stale"):
            late.add("line_without_crc")  # the check was requested again
        assert {name for name in bus.state()["counters"] if name.startswith("line_")} <= late
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(2.0) == 0
