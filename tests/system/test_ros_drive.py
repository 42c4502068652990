"""A ROS user can move the robot with the command exactly as the pages give it."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT
from tests.system import rclpy_stand_in
from tests.system.harness import Bus, Daemon, Program, environment, until
from tests.system.ros_clients import TWIST, BridgeHalf, RmwClient, decode, session_at

pytestmark = [pytest.mark.network, pytest.mark.slow]

LINE = "python3 deploy/ros2/drive.py 0.2 0.0 3"


@pytest.mark.parametrize("way", ["rmw", pytest.param("bridge", marks=pytest.mark.nightly)])
def test_the_command_line_of_the_pages_drives_the_robot(tmp_path: Path, way: str) -> None:
    rclpy_stand_in.write(tmp_path)
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up", 5.0, "the link")
        variables = {"WAY": way, "ENDPOINT": daemon.endpoint, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
        words = [sys.executable, *shlex.split(LINE)[1:]]
        done = subprocess.run(
            words,
            cwd=ROOT,
            env=environment() | variables,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert 0.4 < bus.state()["x"] < 0.7
        until(lambda: bus.state()["linear"] == 0.0, 3.0, "it stands")


@pytest.mark.parametrize(
    ("way", "number"),
    [("rmw", signal.SIGINT), ("rmw", signal.SIGTERM), ("bridge", signal.SIGINT)],
)
@pytest.mark.nightly
def test_the_drive_program_sends_zeros_if_a_signal_ends_it(
    tmp_path: Path, way: str, number: signal.Signals
) -> None:
    rclpy_stand_in.write(tmp_path)
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        session_at(daemon.endpoint) as session,
    ):
        until(lambda: bus.state()["link"] == "up", 5.0, "the link")
        client = {"rmw": RmwClient, "bridge": BridgeHalf}[way](session)
        variables = {"WAY": way, "ENDPOINT": daemon.endpoint, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
        words = [sys.executable, "deploy/ros2/drive.py", "0.2", "0.0", "60"]
        with (
            client.follow("cmd_vel", TWIST) as samples,
            Program(words, ROOT, environment() | variables) as drive,
        ):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 20.0, "it drives")
            drive.signal(number)
            assert drive.ended(5.0) == 128 + number
            assert "Traceback" not in drive.stderr, drive.stderr

            def last() -> float:
                return float(decode(TWIST, samples.seen[-1].payload).linear.x)

            until(lambda: last() == 0.0, 3.0, "the last command is a zero")
