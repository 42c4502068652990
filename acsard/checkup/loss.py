"""Counts lines that are lost or damaged, and finds long silences of the board.

A line that arrives damaged was damaged on the way back. An unanswered line may have been lost in
either direction; `lost_where.py` determines the direction with the motors.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median

from msgspec import Struct

from acsard.checkup import lateness, limits, manual, motion
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError
from acsard.checkup.motion import ZERO, Reply
from acsard.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.formatting import printable_bytes
from acsard.mcu.hearing import SHOWN
from acsard.mcu.session import IDENTITY

MOST = 0.02
"""Largest fraction of lines that may be lost. A sound link loses none."""

FEW = 2
"""Number of lost lines from which on the loss is not a coincidence."""

LINES, LEAST_S, MOST_S = 300, 3.0, 10.0
"""Number of lines that show a loss of 2 %, and shortest and longest duration of the count, s.

The count ends early if no line is lost, and takes longer on a slow wire.
"""

OWN_PACE = 1.5
"""Gap between answers, in periods, above which the board answers at its own, slower pace."""

SILENT = 2.0
"""Multiple of the usual gap above which a gap between two answers counts as a silence."""


class Count(Struct, frozen=True):
    """Counts of lines. The `damaged` ones, which arrived damaged, are among the `lost` ones."""

    lines: int
    lost: int
    damaged: int

    @property
    def share(self) -> float:
        """Fraction of lost lines; 0 if the loss may be a coincidence."""
        return self.lost / self.lines if self.lost >= FEW else 0.0


def finding(board: Board) -> Finding:
    """Send zeros at the host's rate, judge the replies, and set `board.lost`.

    Ends the check if plain lines arrive damaged: lines to the board may then be damaged too, and
    could tell a motor any speed. The loss cannot be determined if the board's pace is unknown.
    """
    if not board.paced:
        return lateness.finding("lost lines", board.lateness.since(0.0))
    board.listen(limits.GLANCE_S)  # later replies answer the lines that are sent now
    began_s, sent, others = board.now_s, board.sent_lines, len(board.others)
    board.drive(ZERO, LEAST_S, _period_s(board))
    silent_s = _silence_s(board, motion.since(board.replies, began_s))
    while True:
        board.listen(limits.GLANCE_S)
        count = _counted(board, began_s, board.sent_lines - sent, others)
        if not count.lost or count.lines >= LINES or board.now_s - began_s > MOST_S:
            break
        board.drive(ZERO, 0.5, _period_s(board))
    board.lost = count.share
    if board.lost <= MOST:
        return _sound(count, silent_s)
    last = printable_bytes(board.others[-1], SHOWN) if count.damaged else ""
    seen = {"share": board.lost, "lines": count.lines, "damaged": count.damaged, "last": last}
    if not count.damaged:
        return manual.find(f"lost lines: {'silent' if board.own_clock else 'either'}", None, **seen)
    found = manual.find(
        f"lost lines: {'back' if 2 * count.damaged > count.lost else 'both'}", None, **seen
    )
    if not board.sealed:
        raise StoppedError(found)
    return found


def _sound(count: Count, silent_s: float) -> Finding:
    if silent_s:
        return manual.find("lost lines: late", lines=count.lines, silent=silent_s * 1000)
    outcome = "few" if count.lost else "none"
    return manual.find(f"lost lines: {outcome}", lines=count.lines, lost=count.lost)


def _period_s(board: Board) -> float:
    """Return the host's period, or a longer one if the board answers less often."""
    longest = line_bytes(board.comma, board.sealed, board.sampled)
    period_s = 1 / min(board.rate_hz, highest_rate(board.baud_rate, longest, COMFORTABLE_USE))
    if not board.own_clock and board.gap_s > OWN_PACE * period_s:
        return 1.25 * board.gap_s
    return period_s


def _counted(board: Board, began_s: float, lines: int, others: int) -> Count:
    damaged = sum(not line.startswith(IDENTITY) for line in board.others[others:])
    got = motion.since(board.replies, began_s)
    if not board.own_clock:
        return Count(lines, max(damaged, lines - len(got)), damaged)
    lost = max(damaged, _left_out(got))
    return Count(len(got) + lost, lost, damaged)


def _gaps(replies: Sequence[Reply]) -> list[float]:
    return [after.at_s - before.at_s for before, after in pairwise(replies)]


def _left_out(replies: Sequence[Reply]) -> int:
    """Return the number of missing replies among evenly spaced ones.

    It is computed over the whole time: a reply that is received late makes one gap longer and the
    next one shorter.
    """
    gaps = _gaps(replies)
    usual = median(gaps) if gaps else 0.0
    alike = [gap for gap in gaps if abs(gap - usual) < usual / 2]
    return max(0, round(sum(gaps) / fmean(alike)) - len(gaps)) if alike else 0


def _silence_s(board: Board, replies: Sequence[Reply]) -> float:
    """Return the longest gap that the host would take for a lost link, s, or 0 if there is none."""
    longest = max(_gaps(replies), default=0.0)
    quiet_s = max(0.1, 4 / board.rate_hz, 3 * board.mcu.reply_period)
    return longest if longest > max(quiet_s, SILENT * board.gap_s) else 0.0
