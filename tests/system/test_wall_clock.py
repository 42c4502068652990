"""A tool shows the same when the wall clock of its own machine or of the robot is set meanwhile."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence

import pytest

from tests.system.harness import Daemon, Finished, acsard, finish, until

pytestmark = pytest.mark.slow

SET_AGAIN = """\
import sys, time

true_ns, began = time.time_ns, time.monotonic()

def told_ns():
    times = int(5 * (time.monotonic() - began))
    return true_ns() + times * (-1) ** times * 3600 * 10**9

time.time_ns, time.time = told_ns, lambda: told_ns() / 1e9
from acsard.cli import main
sys.argv = sys.argv[3:]
sys.exit(main())
"""

SET = (sys.executable, "-c", SET_AGAIN)
"""Prefix for a command: run it on a machine whose clock is set by hours five times a second."""


class Place:
    """A robot and a tool. The test sets the clock of one of them by hours, five times a second."""

    def __init__(self, daemon: Daemon, before: Sequence[str]) -> None:
        self._daemon, self._before = daemon, before

    def tool(self, *words: str) -> Finished:
        typed = acsard(*words, "--connect", self._daemon.endpoint)
        return finish([*self._before, *typed], self._daemon.config.parent)


@pytest.fixture(scope="module", params=["tool", "robot"])
def place(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Place]:
    here = {"tool": ((), SET), "robot": (SET, ())}
    robot, tool = here[request.param]
    with Daemon(tmp_path_factory.mktemp("clock"), before=robot) as daemon:
        yield Place(daemon, tool)


def test_top_says_how_long_ago_the_robot_was_seen_and_how_often_lines_come(place: Place) -> None:
    def rates() -> list[float]:
        output = place.tool("top", "--once").out
        assert re.search(r"seen \d+\.\d s ago", output), output
        return [float(rate) for rate in re.findall(r"(\d+\.\d)/s +\d", output)]

    values = until(rates, 20.0, "how often lines come")
    assert 1 < max(values) < 1000


def test_fleet_says_how_long_ago_the_robot_was_seen(place: Place) -> None:
    output = place.tool("fleet", "--once").out
    match = re.search(r"^acsar .* (\d+\.\d) s ", output, re.M)
    assert match, output
    assert "SILENT" not in output


def test_echo_prints_the_rate_and_the_gaps_of_a_key(place: Place) -> None:
    (line,) = place.tool("echo", "odom", "--rate", "-n", "1").out.splitlines()
    assert float(line.split()[0]) > 1
    assert 0 <= float(line.split()[5]) <= float(line.split()[11]) < 60_000


def test_echo_ends_when_the_timeout_of_silence_is_over_and_not_before(place: Place) -> None:
    ended = place.tool("echo", "state", "-n", "12", "--timeout", "5")
    assert ended.code == 0
    assert len(ended.out.splitlines()) == 12
    ended = place.tool("echo", "imu", "--timeout", "0.5")
    assert (ended.code, ended.out) == (1, "")
    assert 0.5 < ended.seconds < 60
