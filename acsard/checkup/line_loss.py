"""Counts lost and damaged lines.

A reply that arrives damaged was damaged on its way from the board. If a line has no reply, either
the line or its reply was lost. Of a board that reports by its own clock, only lost reports count.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, median

from msgspec import Struct

from acsard.checkup import lateness, motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError
from acsard.checkup.motion import BoardReply
from acsard.core.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.core.formatting import printable_bytes
from acsard.core.link.board_status import IDENTITY
from acsard.core.link.link_diagnosis import MAX_SHOWN_BYTES, is_text

# Largest fraction of lost lines that the check accepts. A good link loses no line.
MAX_LOSS = 0.02

# Smallest number of lost lines that shows a fault. A single lost line may be a coincidence.
MIN_LOST_LINES = 2

# Without a loss, the counting takes `MIN_COUNT_S`, else up to `MAX_COUNTED_LINES` (enough to show 2
# %) or `MAX_COUNT_S`.
MAX_COUNTED_LINES, MIN_COUNT_S, MAX_COUNT_S = 300, 3.0, 10.0

# A gap between two replies is a silence only if it exceeds the mean gap times this number.
SILENCE_FACTOR = 2.0


class Count(Struct, frozen=True):
    """Numbers of all, of lost, and of damaged lines. A damaged line counts as lost too."""

    lines: int
    lost: int
    damaged: int

    @property
    def share(self) -> float:
        """Fraction of lost lines, 0 to 1. It is 0 if fewer than `MIN_LOST_LINES` lines are lost."""
        return self.lost / self.lines if self.lost >= MIN_LOST_LINES else 0.0


def finding(board: Board) -> Finding:
    """Send zeros at the control rate, count the lost lines, and set `board.lost`.

    Raises `StoppedError` if too many lines without a checksum are lost and some arrive damaged,
    because a damaged line could then command any speed.
    """
    if not board.paced:
        return lateness.finding("lost lines", board.lateness.since(0.0))
    # Wait until the replies to earlier lines have arrived.
    board.listen(motion.SHORT_MEASUREMENT_S)
    began_s, sent, others = board.now_s, board.sent_lines, len(board.unrecognized_lines)
    board.drive(board.zero, MIN_COUNT_S, _period_s(board))
    silent_s = _silence_s(board, motion.since(board.replies, began_s))
    while True:
        board.listen(motion.SHORT_MEASUREMENT_S)
        count = _counted(board, began_s, board.sent_lines - sent, others)
        enough = count.lines >= MAX_COUNTED_LINES or board.now_s - began_s > MAX_COUNT_S
        if enough or not count.lost:
            break
        board.drive(board.zero, 0.5, _period_s(board))
    board.lost = count.share
    outcome: outcomes.Outcome
    if board.lost <= MAX_LOSS and silent_s:
        outcome = "lost lines: late"
    elif board.lost <= MAX_LOSS:
        outcome = "lost lines: few" if count.lost else "lost lines: none"
    elif not count.damaged:
        outcome = "lost lines: silent" if board.own_clock else "lost lines: either"
    else:
        mostly_back = 2 * count.damaged > count.lost
        outcome = "lost lines: back" if mostly_back else "lost lines: both"
    last = board.unrecognized_lines[-1] if count.damaged else b""
    result = outcomes.find(
        outcome,
        lines=count.lines,
        lost=count.lost,
        share=board.lost,
        silent=silent_s * 1000,
        damaged=count.damaged,
        last=printable_bytes(last, MAX_SHOWN_BYTES),
    )
    if outcome in ("lost lines: back", "lost lines: both") and not board.sealed:
        raise StoppedError(result)
    return result


def _period_s(board: Board) -> float:
    longest = line_bytes(len(board.letters), board.comma, board.sealed, board.sampled)
    period_s = 1 / min(board.rate_hz, highest_rate(board.baud_rate, longest, COMFORTABLE_USE))
    if not board.own_clock and board.gap_s > 1.5 * period_s:
        return 1.25 * board.gap_s
    return period_s


def _counted(board: Board, began_s: float, lines: int, others: int) -> Count:
    damaged = sum(
        not (line.startswith(IDENTITY) or is_text(line))
        for line in board.unrecognized_lines[others:]
    )
    replies = motion.since(board.replies, began_s)
    if not board.own_clock:
        return Count(lines, max(damaged, lines - len(replies)), damaged)
    lost = max(damaged, _left_out(replies))
    return Count(len(replies) + lost, lost, damaged)


def _left_out(replies: Sequence[BoardReply]) -> int:
    # Compute the number from the time between the first and the last reply. A single long gap does
    # not show a lost reply, because a reply that is received late makes one gap longer and the next
    # gap shorter.
    gaps = motion.gaps(replies)
    usual = median(gaps) if gaps else 0.0
    alike = [gap for gap in gaps if abs(gap - usual) < usual / 2]
    return max(0, round(sum(gaps) / fmean(alike)) - len(gaps)) if alike else 0


def _silence_s(board: Board, replies: Sequence[BoardReply]) -> float:
    longest = max(motion.gaps(replies), default=0.0)
    quiet_s = max(0.1, 4 / board.rate_hz, 3 * board.mcu.reply_period)
    return longest if longest > max(quiet_s, SILENCE_FACTOR * board.gap_s) else 0.0
