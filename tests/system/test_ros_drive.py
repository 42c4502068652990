"""The line of the pages by which a ROS user's robot moves, typed as they say."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT
from tests.system import rclpy_stand_in
from tests.system.harness import Bus, Daemon, environment, until

pytestmark = [pytest.mark.network, pytest.mark.slow]

LINE = "python3 deploy/ros2/drive.py 0.2 0.0 3"


@pytest.mark.parametrize("way", ["rmw", "bridge"])
def test_the_line_of_the_pages_drives(tmp_path: Path, way: str) -> None:
    rclpy_stand_in.write(tmp_path)
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up", 5.0, "the link")
        given = {"WAY": way, "ENDPOINT": daemon.endpoint, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
        words = [sys.executable, *shlex.split(LINE)[1:]]
        done = subprocess.run(
            words, cwd=ROOT, env=environment() | given, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        assert 0.4 < bus.state()["x"] < 0.7
        until(lambda: bus.state()["linear"] == 0.0, 3.0, "it stands")
