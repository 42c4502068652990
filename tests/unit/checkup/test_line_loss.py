"""The check counts lost and damaged lines, and finds the direction in which they are lost.

It needs enough lines to state a rate. It states no direction if the motors do not show it.
"""

from __future__ import annotations

import pytest

from acsard.checkup import dialect, line_loss
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError
from acsard.core.config.settings import Config, SimConfig
from tests.unit.checkup.robots import Checked, Nobody, Robot, check, configured


def run_earlier_steps(board: Board) -> None:
    """Run the steps of the check that come before the count of lost lines."""
    for step in (dialect.baud, dialect.rate, dialect.check):
        step(board)


@pytest.mark.parametrize(
    ("faults", "outcome", "share"),
    [
        (("plain_only",), "PASS", 0.0),
        (("no_sample", "slow_reply"), "PASS", 0.0),
        (("ftdi",), "PASS", 0.0),
        (("sparse_replies",), "PASS", 0.0),
        (("free_running",), "PASS", 0.0),
        (("lost_replies",), "FAIL", 0.2),
        (("lost_commands", "plain_only"), "FAIL", 0.2),
        (("lost_replies", "free_running"), "FAIL", 0.2),
        (("bit_errors",), "FAIL", 0.25),
    ],
)
def test_lost_lines_are_counted_and_other_reply_styles_are_not_losses(
    faults: tuple[str, ...], outcome: str, share: float
) -> None:
    with Robot(*faults).board() as board:
        run_earlier_steps(board)
        finding = line_loss.finding(board)
        assert finding.verdict == outcome
        assert board.lost == pytest.approx(share, abs=0.03)
        assert bool(finding.mend) is (outcome == "FAIL")


@pytest.mark.parametrize(("every", "verdict"), [(25, "FAIL"), (40, "FAIL"), (70, "PASS")])
@pytest.mark.parametrize("way", ["lose_reply", "lose_command"])
def test_a_loss_of_more_than_two_percent_fails(way: str, every: int, verdict: str) -> None:
    robot = Robot()
    setattr(robot.mcu, way, every)
    with robot.board() as board:
        run_earlier_steps(board)
        assert line_loss.finding(board).verdict == verdict


@pytest.mark.parametrize("baud", [9600, 19200])
def test_a_slow_wire_loses_nothing(baud: int) -> None:
    with Robot(config=configured(Config(), baud_rate=baud)).board() as board:
        run_earlier_steps(board)
        assert (line_loss.finding(board).verdict, board.lost) == ("PASS", 0.0)


def test_a_board_whose_plain_lines_arrive_damaged_ends_the_check_before_motors_turn() -> None:
    class Noisy(Robot):
        pieces = 0

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            chunks = super().listen(until_ns)
            self.pieces += len(chunks)
            return [
                (at, d[:9] + b"\xae" + d[10:] if self.pieces % 9 == 0 else d) for at, d in chunks
            ]

    robot = Noisy("plain_only")
    with robot.board() as board:
        run_earlier_steps(board)
        with pytest.raises(StoppedError) as end:
            line_loss.finding(board)
    assert "arrived damaged from the board, the last one is `" in end.value.finding.text
    assert "ground" in end.value.finding.mend
    assert robot.mcu.vehicle.angles == [0.0] * 4


def test_a_silence_is_reported_as_a_silence() -> None:
    with Robot("stalls=1:0.2").board() as board:
        run_earlier_steps(board)
        finding = line_loss.finding(board)
    assert finding.verdict == "WARN"
    assert "but nothing arrived for" in finding.figure
    assert "USB" in finding.mend


@pytest.mark.variations(3)
@pytest.mark.parametrize("fault", ["lost_replies", "lost_commands", "bit_errors"])
def test_a_link_that_loses_lines_proposes_no_counts(fault: str) -> None:
    checked = check(fault)
    assert "lost lines" in checked.failed
    assert checked["encoder counts"].verdict == "SKIPPED"
    assert "mcu.encoder_counts" not in checked.changes


ALL = [0, 1, 2, 3]


def line_loss_finding(board: Board, motors: list[int], lost: float = 0.2) -> Finding | None:
    board.lost = lost
    return line_loss.direction(board, Nobody(), motors)


@pytest.mark.variations(3)
@pytest.mark.parametrize("firmware", ["no_sample", "plain_only", "comma_latched"])
@pytest.mark.parametrize(
    ("command", "reply", "figure", "mend"),
    [
        (5, 0, "0 on the way back", "the computer's TX to the board's RX"),
        (0, 5, "0 lost on the way out", "the board's TX to the computer's RX"),
        (4, 3, "", "first the ground of board and computer"),
    ],
)
def test_the_lossy_direction_is_found_by_the_motion_of_the_motors(
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
def test_commands_lost_to_a_free_running_board_are_found(fault: str, verdict: str) -> None:
    assert check("free_running", fault, reply_period=0.1)["lost where"].verdict == verdict


@pytest.mark.slow
@pytest.mark.parametrize("earlier", range(1, 5))
def test_lost_commands_are_found_whichever_line_is_lost_first(earlier: int) -> None:
    class Spoken(Robot):
        def open(self, baud_rate: int) -> None:
            super().open(baud_rate)
            for _ in range(earlier):
                self.mcu.receive(self.now_ns(), b"ap00.00,bp00.00,cp00.00,dp00.00\r\n")

    checked = Checked(Spoken("free_running", "lost_commands", reply_period=0.1))
    assert checked["lost where"].verdict == "FAIL"


@pytest.mark.parametrize(
    ("lag", "per_turn"), [(0.0, 3200), (0.3, 3200), (1.0, 3200), (2.0, 3200), (0.05, 16)]
)
@pytest.mark.parametrize(
    ("fault", "right"), [("lost_replies", "the board's TX"), ("lost_commands", "the computer's TX")]
)
def test_slow_motors_and_coarse_encoders_do_not_blame_the_wrong_direction(
    lag: float, per_turn: int, fault: str, right: str
) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    with Robot(fault, config=config).board() as board:
        finding = line_loss_finding(board, ALL)
        assert finding is not None
        assert finding.verdict == "SKIPPED" or f"the lead from {right}" in finding.mend
        assert not board.turning()


def test_without_a_motor_that_turns_the_lossy_direction_is_skipped() -> None:
    with Robot("lost_replies").board() as board:
        finding = line_loss_finding(board, [])
    assert finding is not None
    assert finding.verdict == "SKIPPED"


def test_if_no_lines_are_lost_no_motor_turns() -> None:
    robot = Robot()
    with robot.board() as board:
        assert line_loss_finding(board, ALL, line_loss.MAX_LOSS) is None
    assert robot.mcu.vehicle.angles == [0.0] * 4


def test_the_test_of_the_lossy_direction_leaves_no_motor_turning() -> None:
    robot = Robot("lost_commands", "no_watchdog")
    with robot.board() as board:
        assert line_loss_finding(board, ALL) is not None
        assert not board.turning()
    assert not any(robot.later())
