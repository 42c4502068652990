"""The daemon process loses no recording when it is killed or ended, and drives on without a disk.

It also drives on when the disk is full. `test_recording_disks.py` tests real disks that fail.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.system import bystander
from tests.system.harness import Bus, Daemon, acsard, finish, until

LOST_S = 1.5
"""The recording that a kill or a power cut may cost at most."""


@contextmanager
def recording(where: Path, name: str = "daemon", **how: Any) -> Iterator[tuple[Daemon, Bus]]:
    """Run a daemon that records to `where/record`. Yield it and a client once its link is up."""
    words = ["--record", str(where / "record")]
    with Daemon(where, name=name, words=words, **how) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up", 5.0, "link up")
        yield daemon, bus


def files(where: Path) -> list[Path]:
    """Return the recordings in `where/record`, the oldest first."""
    return sorted(where.glob("record/*.rec.zst"))


def replayed(where: Path, path: Path) -> int:
    """Return the number of lines in a recording, and check that a replay reproduces all of them."""
    ended = finish(acsard("recording", "replay", str(path)), where)
    assert ended.code == 0, ended
    match = re.match(r"([\d ]+) of ([\d ]+) lines are the same", ended.out)
    assert match, ended
    assert match[1] == match[2]
    return int(match[1].replace(" ", ""))


def last_s(where: Path, path: Path) -> float:
    """Return the wall-clock time of the last readable step of a recording, s."""
    code = (
        "import sys, pathlib; from acsard.recording.file import Recording;"
        "recording = Recording([pathlib.Path(sys.argv[1])]);"
        "print(max(step.now.wall_ns for step in recording.steps()))"
    )
    return int(finish([sys.executable, "-c", code, str(path)], where).out) / 1e9


def killed(where: Path, seconds: float) -> Path:
    """Kill a daemon after these seconds of a drive, and return its recording."""
    began, before = time.monotonic(), set(files(where))
    with recording(where) as (daemon, bus):
        with bus.commanding(0.3):
            time.sleep(seconds)
        daemon.process.kill()
        end_s, end = time.time(), time.monotonic()
        daemon.process.wait()
    (path,) = set(files(where)) - before
    late = bystander.lost(began, end)
    assert end_s - last_s(where, path) < LOST_S + late
    assert replayed(where, path) > 0
    return path


@pytest.mark.slow
def test_a_kill_costs_little_and_the_file_stays_as_it_is(tmp_path: Path) -> None:
    path = killed(tmp_path, 1.5)
    content = path.read_bytes()
    assert killed(tmp_path, 1.5).name > path.name
    assert path.read_bytes() == content


BUG = """\
from acsard.core.robot import Robot
whole = Robot.hear
def hear(robot, now, heard):
    if heard.requests:
        raise ZeroDivisionError("a fault of our own")
    return whole(robot, now, heard)
Robot.hear = hear
"""
"""Injected into the daemon: the robot raises an exception for a stop."""


@pytest.mark.slow
def test_a_recording_is_complete_after_an_orderly_end_and_readable_only_by_its_group(
    tmp_path: Path,
) -> None:
    with recording(tmp_path, before=["sh", "-c", 'umask 0; exec "$@"', "sh"]) as (daemon, bus):
        with bus.commanding(0.3):
            until(lambda: bus.state()["mode"] == "driving", 5.0, "drives")
        daemon.process.terminate()
        assert daemon.ended(5.0) == 0
    (path,) = files(tmp_path)
    assert path.stat().st_mode & 0o777 == 0o640
    assert path.parent.stat().st_mode & 0o777 == 0o750
    assert replayed(tmp_path, path) > 3
