"""The check counts lost and damaged lines. It needs enough lines to state a rate."""

from __future__ import annotations

import pytest

from acsard.checkup import dialect, line_loss
from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.core.config.settings import Config
from tests.unit.checkup.robots import Robot, check, configured


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
