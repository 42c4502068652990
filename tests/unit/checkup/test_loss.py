"""Lost and damaged lines are counted, and a rate is given only for enough lines."""

from __future__ import annotations

import pytest

from acsard.checkup import counts, dialect, loss, pace
from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.config.settings import Config
from tests.unit.checkup.robots import Robot, check, configured


def known(board: Board) -> None:
    """Run the steps of the check that come before the count."""
    for step in (dialect.baud, pace.rate, dialect.check):
        step(board)


@pytest.mark.parametrize(
    ("faults", "outcome", "share"),
    [
        (("plain_only",), "PASS", 0.0),
        (("no_sample", "slow_reply"), "PASS", 0.0),
        (("ftdi",), "PASS", 0.0),
        (("sparse_replies",), "PASS", 0.0),
        (("unprompted",), "PASS", 0.0),
        (("lost_replies",), "FAIL", 0.2),
        (("lost_commands", "plain_only"), "FAIL", 0.2),
        (("lost_replies", "unprompted"), "FAIL", 0.2),
        (("bit_errors",), "FAIL", 0.25),
    ],
)
def test_lost_lines_are_counted_and_other_ways_of_answering_are_none(
    faults: tuple[str, ...], outcome: str, share: float
) -> None:
    with Robot(*faults).board() as board:
        known(board)
        found = loss.finding(board)
        assert found.verdict == outcome
        assert board.lost == pytest.approx(share, abs=0.03)
        assert bool(found.mend) is (outcome == "FAIL")


@pytest.mark.parametrize(("every", "verdict"), [(25, "FAIL"), (40, "FAIL"), (70, "PASS")])
@pytest.mark.parametrize("way", ["lose_reply", "lose_command"])
def test_above_two_in_a_hundred_it_fails(way: str, every: int, verdict: str) -> None:
    robot = Robot()
    setattr(robot.mcu, way, every)
    with robot.board() as board:
        known(board)
        assert loss.finding(board).verdict == verdict


@pytest.mark.parametrize("baud", [9600, 19200])
def test_a_slow_wire_loses_nothing(baud: int) -> None:
    with Robot(config=configured(Config(), baud_rate=baud)).board() as board:
        known(board)
        assert (loss.finding(board).verdict, board.lost) == ("PASS", 0.0)


def test_plain_lines_that_come_damaged_turn_no_motor() -> None:
    class Noisy(Robot):
        pieces = 0

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            got = super().listen(until_ns)
            self.pieces += len(got)
            return [(at, d[:9] + b"\xae" + d[10:] if self.pieces % 9 == 0 else d) for at, d in got]

    robot = Noisy("plain_only")
    with robot.board() as board:
        known(board)
        with pytest.raises(StoppedError) as end:
            loss.finding(board)
    assert "came damaged from the board, the last `" in end.value.finding.text
    assert "ground" in end.value.finding.mend
    assert robot.mcu.vehicle.angles == [0.0] * 4


def test_silences_are_told_for_what_they_are() -> None:
    with Robot("stalls=1:0.2").board() as board:
        known(board)
        found = loss.finding(board)
    assert found.verdict == "WARN"
    assert "silent for" in found.figure
    assert "USB" in found.mend


@pytest.mark.variations(3)
@pytest.mark.parametrize("fault", ["lost_replies", "lost_commands", "bit_errors"])
def test_a_link_that_loses_lines_proposes_no_counts(fault: str) -> None:
    checked = check(fault)
    assert "lost lines" in checked.failed
    assert checked["encoder counts"].verdict == "SKIPPED"
    assert "mcu.encoder_counts" not in checked.changes


def test_counts_are_measured_where_nothing_is_lost() -> None:
    with Robot().board() as board:
        known(board)
        board.lost = loss.MOST
        assert counts.finding(board, []).verdict == "SKIPPED"
        board.identity = {"counts": "3200"}
        assert counts.finding(board, []).keys == {"mcu.encoder_counts": 3200}
        board.lost = 2 * loss.MOST
        assert counts.finding(board, []).keys == {}
