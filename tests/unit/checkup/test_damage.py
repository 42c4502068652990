"""The host accepts no damaged line, and the check reports firmware that accepts one."""

from __future__ import annotations

import re

import pytest

from acsard.checkup import damage, dialect
from acsard.core.config.settings import WheelMap
from acsard.core.link.codec import Codec, FrameError
from acsard.core.simulator import protocol
from tests.unit.checkup.robots import Robot


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("sealed", [False, True])
def test_the_parser_refuses_every_broken_line(comma: bool, sealed: bool) -> None:
    lines = damage.broken_lines(comma, sealed, [0, 1, 2, 3])
    assert len(lines) == (12 if sealed else 10)
    assert all(any(line.endswith(end) for _, line in lines) for end in (b"dp03.0\r\n", b"dp0\r\n"))
    for what, line in lines:
        assert protocol.reference(line) is None, what
        if "last number" in what:
            continue  # the host also reads replies with another number of decimals
        with pytest.raises(FrameError):
            Codec(WheelMap()).decode(line.rstrip())


@pytest.mark.parametrize(
    ("fault", "verdict"),
    [
        ("no_sample", "PASS"),
        ("plain_only", "PASS"),
        ("no_check", "WARN"),
        ("comma_latched", "FAIL"),
    ],
)
def test_firmware_that_obeys_parts_of_lines_is_reported(fault: str, verdict: str) -> None:
    robot = Robot(fault, "no_watchdog", trailing_comma=True)
    with robot.board() as board:
        dialect.check(board)
        assert damage.finding(board, [0, 1, 2, 3]).verdict == verdict
        assert board.turning() == []
    assert robot.later() == [0.0] * 4


def test_firmware_that_reads_a_last_number_that_is_cut_is_reported() -> None:
    def scanned(line: bytes) -> protocol.Command | None:
        """Parse as `sscanf` does: accept a last number whose end is missing."""
        match = re.match(rb"ap(\d\d\.\d\d),bp(\d\d\.\d\d),cp(\d\d\.\d\d),dp([\d.]+),?\r\n\Z", line)
        return match and protocol.Command({m: float(match[m + 1]) for m in range(4)})

    robot = Robot()
    with robot.board() as board:
        robot.mcu.understand = scanned
        finding = damage.finding(board, [0, 1, 2, 3])
    assert finding.verdict == "FAIL"
    assert finding.text.count("cut inside the last number") == 1


def test_motors_that_do_not_turn_as_commanded_are_left_out() -> None:
    lines = damage.broken_lines(False, False, [1])
    assert all(b"ap03" not in line for _, line in lines)
    assert any(b"bp03" in line for _, line in lines)
    with Robot().board() as board:
        assert damage.finding(board, []).verdict == "SKIPPED"
