"""Measures when replies arrive: bunches behind a silence show a firmware that blocks its loop."""

from __future__ import annotations

from acsard.checkup import lateness, motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding

MEASUREMENT_S = 2.0

# A reply that comes within this share of the usual gap behind the one before belongs to a bunch,
# and a silence is this many usual gaps.
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
    usual_s, longest_s = gaps[len(gaps) // 2], gaps[-1]
    bunched = sum(gap < BUNCH_FRACTION * usual_s for gap in gaps) / len(gaps)
    blocks = bunched > MAX_BUNCHED and longest_s > SILENCE_FACTOR * usual_s
    return outcomes.find(
        f"reply times: {'bunched' if blocks else 'even'}",
        usual=usual_s * 1000,
        high=gaps[len(gaps) * 99 // 100] * 1000,
        longest=longest_s * 1000,
        share=bunched,
    )
