"""However it is measured, the true time of the watchdog lies within what is told."""

from __future__ import annotations

import pytest

from acsard.checkup import dialect, pace
from acsard.checkup.findings import StoppedError
from acsard.checkup.turning import turn
from acsard.checkup.watchdog import UNKNOWN, Between, measured, run
from acsard.sim import protocol
from tests.unit.checkup.robots import Robot

ALL = (0, 1, 2, 3)
SLACK_S = 0.02
"""A reply's own time, which the interval does not hold."""


def silence(robot: Robot) -> Between:
    with robot.board() as board:
        pace.rate(board)
        dialect.check(board)
        for motor in ALL:
            turn(board, motor, 3.0)
            board.rest()
        found = measured(board, ALL, run(board, ALL, 0.0))
        assert board.turning() == []
    return found


@pytest.mark.parametrize("kind", [("plain_only",), (), ("unprompted",)])
@pytest.mark.parametrize("time_s", [0.2, 0.37])
def test_the_true_time_lies_between_what_is_told(kind: tuple[str, ...], time_s: float) -> None:
    robot = Robot(*kind)
    robot.mcu.watchdog_ns = int(time_s * 1e9)
    least_s, most_s = silence(robot)
    assert least_s - SLACK_S <= time_s <= most_s + SLACK_S
    assert most_s - least_s < 0.2


@pytest.mark.parametrize("kind", ["plain_only", "no_sample", "unprompted"])
def test_motors_that_never_stop_have_no_time(kind: str) -> None:
    assert silence(Robot(kind, "no_watchdog"))[1] == UNKNOWN


def test_motors_that_turn_alone_but_not_together_end_the_check() -> None:
    def gives_in(line: bytes) -> protocol.Command | None:
        command = protocol.whole(line)
        if command and sum(map(bool, command.values.values())) > 1:
            return protocol.Command(dict.fromkeys(command.values, 0.0))
        return command

    robot = Robot("plain_only")
    with robot.board() as board:
        robot.mcu.understand = gives_in
        assert turn(board, 0, 3.0)[0] == pytest.approx(3.0, abs=0.1)
        board.rest()
        with pytest.raises(StoppedError) as end:
            run(board, ALL, 0.0)
    assert "not together" in end.value.finding.text
