"""The check turns motors to find the direction in which lines are lost.

It states no direction if the motors cannot show it.
"""

from __future__ import annotations

import pytest

from acsard.checkup import loss, lost_where
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.config.settings import Config, SimConfig
from tests.unit.checkup.robots import Checked, Nobody, Robot, check

ALL = [0, 1, 2, 3]


def found(board: Board, motors: list[int], lost: float = 0.2) -> Finding | None:
    board.lost = lost
    return lost_where.finding(board, Nobody(), motors)


@pytest.mark.variations(3)
@pytest.mark.parametrize("firmware", ["no_sample", "plain_only", "comma_latched"])
@pytest.mark.parametrize(
    ("command", "reply", "figure", "mend"),
    [
        (5, 0, "0 back", "the computer's TX to the board's RX"),
        (0, 5, "0 of", "the board's TX to the computer's RX"),
        (4, 3, "", "the ground of board and computer first"),
    ],
)
def test_the_way_is_told_by_what_the_motors_did(
    firmware: str, command: int, reply: int, figure: str, mend: str
) -> None:
    robot = Robot(firmware, trailing_comma=firmware == "comma_latched")
    robot.mcu.lose_command, robot.mcu.lose_reply = command, reply
    checked = Checked(robot)
    finding = checked["lost where"]
    assert finding.verdict == "FAIL"
    assert figure in finding.figure
    assert mend in finding.mend
    assert not checked.left_turning


@pytest.mark.parametrize(
    ("fault", "verdict"),
    [("lost_commands", "FAIL"), ("lost_replies", "SKIPPED"), ("spaces", "PASS")],
)
def test_commands_lost_to_a_board_that_reports_by_its_own_clock_are_seen(
    fault: str, verdict: str
) -> None:
    assert check("unprompted", fault, reply_period=0.1)["lost where"].verdict == verdict


@pytest.mark.slow
@pytest.mark.parametrize("earlier", range(1, 5))
def test_it_does_not_matter_which_of_the_lines_is_the_first_that_is_lost(earlier: int) -> None:
    class Spoken(Robot):
        def open(self, baud_rate: int) -> None:
            super().open(baud_rate)
            for _ in range(earlier):
                self.mcu.receive(self.now_ns(), b"ap00.00,bp00.00,cp00.00,dp00.00\r\n")

    checked = Checked(Spoken("unprompted", "lost_commands", reply_period=0.1))
    assert checked["lost where"].verdict == "FAIL"


@pytest.mark.parametrize(
    ("lag", "per_turn"), [(0.0, 3200), (0.3, 3200), (1.0, 3200), (2.0, 3200), (0.05, 16)]
)
@pytest.mark.parametrize(
    ("fault", "right"), [("lost_replies", "the board's TX"), ("lost_commands", "the computer's TX")]
)
def test_slow_motors_and_coarse_encoders_blame_no_wrong_way(
    lag: float, per_turn: int, fault: str, right: str
) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    with Robot(fault, config=config).board() as board:
        finding = found(board, ALL)
        assert finding is not None
        assert finding.verdict == "SKIPPED" or f"the lead from {right}" in finding.mend
        assert not board.turning()


def test_without_a_motor_that_turns_the_way_is_not_told() -> None:
    with Robot("lost_replies").board() as board:
        finding = found(board, [])
    assert finding is not None
    assert finding.verdict == "SKIPPED"


def test_where_nothing_is_lost_nothing_is_turned() -> None:
    robot = Robot()
    with robot.board() as board:
        assert found(board, ALL, loss.MOST) is None
    assert robot.mcu.vehicle.angles == [0.0] * 4


def test_no_pulse_feeds_a_motor_for_longer_than_the_watchdog_allows() -> None:
    robot = Robot("lost_commands", "no_watchdog")
    with robot.board() as board:
        assert found(board, ALL) is not None
        assert not board.turning()
    assert not any(robot.later())
