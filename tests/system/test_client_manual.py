"""The manual's examples in Python do what it says, against a running daemon."""

from __future__ import annotations

import json
import math
import re
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.pages import blocks
from tests.system.bystander import lost
from tests.system.harness import Finished, finish, kept_waiting, running, silences
from tests.system.strangers import command_line

PAGES = [f"deploy/manual/pages/{name}.md" for name in ("tutorial/program", "howto/languages")]


class Outcome(NamedTuple):
    """An example's exit, the robot's final state, and the time lost to other programs, s."""

    ended: Finished
    state: Any
    late: float


def kind(code: str) -> str:
    """Return the name of the example that has this code."""
    if "connect_async" in code:
        return "async"
    return "first" if "acsard.client" in code else "plain zenoh"


def ran(name: str, where: Path) -> Outcome:
    """Run an example of the pages, with the endpoint of a robot of its own."""
    texts = (block.text for block in blocks("python") if block.page in PAGES)
    (code,) = (text for text in texts if kind(text) == name)
    with running(where) as (daemon, bus), bus.follow("cmd/app") as commands:
        code = re.sub(r"(connect|connect_async)\(\)", rf'\1("{daemon.endpoint}")', code)
        code = code.replace("tcp/127.0.0.1:7448", daemon.endpoint)
        begun, waited_s = time.monotonic(), kept_waiting(daemon.pid)
        ended = finish(command_line(code), where)
        state = bus.at_rest()
        late = lost(begun) + kept_waiting(daemon.pid) - waited_s
    return Outcome(ended, state, late + silences([entry.at for entry in commands.seen]))


@pytest.mark.slow
def test_the_first_example_of_the_manual_drives_one_metre_turns_and_prints_the_pose(
    tmp_path: Path,
) -> None:
    ended, state, late = ran("first", tmp_path)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("Pose(x=")
    # If a message comes late, the robot drives on meanwhile, at 0.02 m/s near the end.
    assert state["x"] == pytest.approx(1.0, abs=0.005 + 0.02 * late)
    assert state["yaw"] == pytest.approx(math.radians(90.0), abs=math.radians(0.5 + 3.0 * late))
    # The example prints where the robot came to a stand, not where it still rolled.
    printed = re.match(r"Pose\(x=([\d.]+),", ended.out)
    assert printed
    assert float(printed[1]) == pytest.approx(state["x"], abs=0.01)
    assert state["y"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_the_async_example_of_the_manual_follows_the_robot_while_it_drives(
    tmp_path: Path,
) -> None:
    ended, state, late = ran("async", tmp_path)
    assert (ended.code, ended.err) == (0, "")
    assert len(ended.out.splitlines()) >= 3  # one of 50 messages, 100 a second
    assert state["yaw"] == pytest.approx(0.4, abs=0.02 + 0.2 * late)
    assert state["x"] == pytest.approx(0.97, abs=0.05 + 0.5 * late)


@pytest.mark.slow
def test_the_plain_zenoh_example_of_the_manual_drives_one_metre_and_follows_the_odometry(
    tmp_path: Path,
) -> None:
    ended, state, late = ran("plain zenoh", tmp_path)
    assert (ended.code, ended.err) == (0, "")
    odometry = [json.loads(line) for line in ended.out.splitlines()]
    assert len(odometry) > 10
    assert {odom["child_frame_id"] for odom in odometry} == {"base_link"}
    first, last = (
        message["pose"]["pose"]["position"]["x"] for message in (odometry[0], odometry[-1])
    )
    assert first < 0.5 * state["x"] < last
    # The example's own sleeps add up to a little more than 2 s.
    assert state["x"] == pytest.approx(1.03, abs=0.05 + 0.5 * late), state["counters"]
