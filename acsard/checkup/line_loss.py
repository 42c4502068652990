"""Counts lost and damaged lines, and finds out in which direction lines are lost.

A reply that arrives damaged was damaged on its way from the board. A line without a reply, or its
reply, was lost. To tell which, the check sends pulses: single lines that turn the motors for a
moment. If the motors obey, the reply was lost, and else the line.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, median

from msgspec import Struct

from acsard.checkup import lateness, motion, outcomes
from acsard.checkup.board import Board, Operator
from acsard.checkup.findings import Finding, StoppedError
from acsard.checkup.motion import ZERO, BoardReply
from acsard.core.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes
from acsard.core.formatting import printable_bytes
from acsard.core.link.link_diagnosis import MAX_SHOWN_BYTES
from acsard.core.link.session import IDENTITY

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
    board.drive(ZERO, MIN_COUNT_S, _period_s(board))
    silent_s = _silence_s(board, motion.since(board.replies, began_s))
    while True:
        board.listen(motion.SHORT_MEASUREMENT_S)
        count = _counted(board, began_s, board.sent_lines - sent, others)
        enough = count.lines >= MAX_COUNTED_LINES or board.now_s - began_s > MAX_COUNT_S
        if enough or not count.lost:
            break
        board.drive(ZERO, 0.5, _period_s(board))
    board.lost = count.share
    if board.lost <= MAX_LOSS:
        outcome = "late" if silent_s else "few" if count.lost else "none"
    elif not count.damaged:
        outcome = "silent" if board.own_clock else "either"
    else:
        outcome = "back" if 2 * count.damaged > count.lost else "both"
    last = board.unrecognized_lines[-1] if count.damaged else b""
    result = outcomes.find(
        f"lost lines: {outcome}",
        lines=count.lines,
        lost=count.lost,
        share=board.lost,
        silent=silent_s * 1000,
        damaged=count.damaged,
        last=printable_bytes(last, MAX_SHOWN_BYTES),
    )
    if outcome in ("back", "both") and not board.sealed:
        raise StoppedError(result)
    return result


def _period_s(board: Board) -> float:
    longest = line_bytes(board.comma, board.sealed, board.sampled)
    period_s = 1 / min(board.rate_hz, highest_rate(board.baud_rate, longest, COMFORTABLE_USE))
    if not board.own_clock and board.gap_s > 1.5 * period_s:
        return 1.25 * board.gap_s
    return period_s


def _counted(board: Board, began_s: float, lines: int, others: int) -> Count:
    damaged = sum(not line.startswith(IDENTITY) for line in board.unrecognized_lines[others:])
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


# From a pulse to its zeros: long enough for the encoders, too short for the watchdog.
PULSE_S = 0.08

# Pulses are sent until this many had no reply, or for `MAX_PULSES_S`.
MAX_UNANSWERED_PULSES, MAX_PULSES_S = 8, 20.0

# Pulse n is followed by (n * `STRIDE`) % `SPREAD` more periods, because a link that loses every
# tenth line might never lose an evenly spaced pulse.
SPREAD, STRIDE = 12, 5

# Of the median angle of the pulses: a smaller angle means that a pulse was lost.
OBEYED_FRACTION = 0.5

# The median angle, rad and in the smallest steps of the encoders, that shows which pulses arrived.
MIN_PULSE_ANGLE, MIN_PULSE_STEPS = 0.02, 4


class PulseCounts(Struct, frozen=True):
    """Numbers of measured pulses, of pulses lost on their way, and of lost replies to pulses."""

    sent: int
    lost_out: int
    lost_back: int


def direction(board: Board, operator: Operator, motors: Sequence[int]) -> Finding | None:
    """Find out whether lines or replies are lost, by `motors`, which turn briefly.

    Return None for a prompted board that loses no more than `MAX_LOSS`.
    """
    if not (board.own_clock or board.lost > MAX_LOSS):
        return None
    operator.doing("the motors turn briefly, several times, to find out where lines are lost")
    counts = pulsed(board, motors) if motors else None
    if counts is None:
        return outcomes.find("lost where: untold")
    if counts.lost_out + counts.lost_back < MIN_LOST_LINES:
        outcome = "not seen"
    elif min(counts.lost_out, counts.lost_back) >= MIN_LOST_LINES:
        outcome = "both"
    else:
        outcome = "there" if counts.lost_out > counts.lost_back else "back"
    there, back = counts.lost_out, counts.lost_back
    return outcomes.find(f"lost where: {outcome}", sent=counts.sent, there=there, back=back)


def pulsed(board: Board, motors: Sequence[int]) -> PulseCounts | None:
    """Send pulses from a standstill, and count the lost pulses and the lost replies.

    Return None if the movement does not show which pulses arrived.
    """
    on = motion.only(motors)
    # If the board reports by its own clock, no earlier step has found a loss of lines to the board,
    # so a shorter search is enough.
    end_s = board.now_s + (10.0 if board.own_clock else MAX_PULSES_S)
    every: list[float] = []
    unanswered: list[float] = []
    count = 0
    while len(unanswered) < MAX_UNANSWERED_PULSES and board.now_s < end_s:
        # The reply to an earlier line must not be taken for the reply to this pulse.
        board.listen(motion.SHORT_MEASUREMENT_S / 4)
        since_s, coasting = board.now_s, board.replies[-1].motors
        answered = bool(board.drive(on, PULSE_S, PULSE_S))
        board.drive(ZERO, 2 * board.gap_s + (4 + STRIDE * count % SPREAD) * board.period_s)
        if not _wait_until_still(board):
            return None
        count += 1
        if board.own_clock and not _whole(board, since_s):
            continue
        ran, passed_s = motion.covered(board.replies, since_s), board.now_s - since_s
        every.append(max(abs(ran[m]) - abs(coasting[m]) * passed_s for m in motors))
        if not (answered or board.own_clock):
            unanswered.append(every[-1])
    usual = median(every) if every else 0.0
    if usual < max(MIN_PULSE_ANGLE, MIN_PULSE_STEPS * _grain(board, motors)):
        return None
    if board.own_clock and len(every) < MAX_UNANSWERED_PULSES:
        return None
    if board.own_clock:
        return PulseCounts(len(every), sum(angle < OBEYED_FRACTION * usual for angle in every), 0)
    back = sum(angle >= OBEYED_FRACTION * usual for angle in unanswered)
    return PulseCounts(len(every), len(unanswered) - back, back)


def _whole(board: Board, since_s: float) -> bool:
    gaps = motion.gaps(motion.since(board.replies, since_s - board.gap_s))
    return all(gap_s < 1.5 * board.gap_s for gap_s in gaps)


def _grain(board: Board, motors: Sequence[int]) -> float:
    course = motion.steps(board.replies)
    angles = [abs(step.speeds[m]) * step.seconds for step in course for m in motors]
    return min((angle for angle in angles if angle), default=0.0)


def _wait_until_still(board: Board) -> bool:
    began_s = board.now_s
    while board.turning():
        if board.now_s - began_s > motion.MOTOR_TIMEOUT_S / 2:
            board.stop_motors()
            return False
        board.send_zero()
    return True
