"""Measures when replies arrive: bunches behind silences show that something holds replies back."""

from __future__ import annotations

from statistics import fmean, median

from acsard.checkup import lateness, motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding

MEASUREMENT_S = 2.0

# A reply that comes within this share of the mean gap behind the one before belongs to a bunch,
# and a silence is this many mean gaps.
BUNCH_FRACTION, SILENCE_FACTOR = 0.3, 3.0

MAX_BUNCHED = 0.03  # of the replies: a queue of this computer bunches single ones


def finding(board: Board) -> Finding | None:
    """Send zeros at the control rate, and return how the replies are spread over the time."""
    if not board.paced:
        return lateness.finding("reply times", board.lateness.since(0.0))
    period_s = max(1 / board.rate_hz, board.period_s / 2)
    gaps = sorted(motion.gaps(board.drive(board.zero, MEASUREMENT_S, period_s)))
    if len(gaps) < 10:
        return None  # the row of the reply rate says so
    # The median would be the gap inside a bunch if most replies come in bunches.
    usual_s, longest_s = fmean(gaps), gaps[-1]
    # The wire spreads a bunch.
    close_s = max(BUNCH_FRACTION * usual_s, min(board.line_s, usual_s / 2))
    bunched = sum(gap < close_s for gap in gaps) / len(gaps)
    blocks = bunched > MAX_BUNCHED and longest_s > SILENCE_FACTOR * usual_s
    return outcomes.find(
        "reply times: bunched" if blocks else "reply times: even",
        middle=median(gaps) * 1000,
        high=gaps[len(gaps) * 99 // 100] * 1000,
        longest=longest_s * 1000,
        share=bunched,
    )
