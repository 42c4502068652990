"""Broken lines: none is a line, and firmware that takes one is told."""

from __future__ import annotations

import pytest

from acsard.checkup import damage, dialect
from acsard.mcu.frames import Codec, FrameError
from acsard.settings import WheelMap
from acsard.sim import protocol
from tests.unit.checkup.robots import Robot


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("sealed", [False, True])
def test_none_of_the_broken_lines_is_a_line(comma: bool, sealed: bool) -> None:
    lines = damage.broken_lines(comma, sealed, [0, 1, 2, 3])
    assert len(lines) == (10 if sealed else 8)
    for broken in lines:
        assert protocol.whole(broken.line) is None, broken.what
        with pytest.raises(FrameError):
            Codec(WheelMap()).decode(broken.line.rstrip())


@pytest.mark.parametrize(
    ("fault", "verdict"),
    [
        ("no_sample", "PASS"),
        ("plain_only", "PASS"),
        ("no_check", "WARN"),
        ("comma_latched", "FAIL"),
    ],
)
def test_firmware_that_takes_parts_is_told(fault: str, verdict: str) -> None:
    robot = Robot(fault, "no_watchdog", trailing_comma=True)
    with robot.bench() as bench:
        dialect.check(bench)
        assert damage.finding(bench, [0, 1, 2, 3]).verdict == verdict
        assert bench.turning() == []
    assert robot.later() == [0.0] * 4


def test_motors_that_do_not_turn_as_told_are_left_out() -> None:
    lines = damage.broken_lines(False, False, [1])
    assert all(b"ap03" not in broken.line for broken in lines)
    assert any(b"bp03" in broken.line for broken in lines)
    with Robot().bench() as bench:
        assert damage.finding(bench, []).verdict == "SKIPPED"
