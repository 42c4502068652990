"""Finds the direction in which lines are lost: to the board, or back.

Single lines turn standing motors for a moment, again and again. A line that the motors obeyed has
arrived, so its answer was the one that got lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from msgspec import Struct

from acsard.checkup import limits, loss, manual, motion
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.motion import ZERO
from acsard.checkup.outside import Operator

PULSE_S = 0.08
"""Time for which a single line turns the motors, s.

It is long enough to see and shorter than the watchdog.
"""

TOLD, PULSES_S = 8, 20.0
"""Number of unanswered pulses that shows the direction, and longest time to wait for them, s."""

OWN_CLOCK_S = 10.0
"""Duration for a board that reports by its own clock, s.

Such a board answers no line, so nothing has shown yet whether any line is lost.
"""

SPREAD, STRIDE = 12, 5
"""Number of different pauses between pulses, and the stride by which they are ordered.

With equal pauses, losses at regular intervals could miss every pulse.
"""

OBEYED = 0.5
"""Fraction of the usual angle of a pulse above which the motors obeyed it."""

SEEN, GRAINS = 0.02, 4
"""Smallest usable angle of a pulse, in rad and in smallest steps of the encoders."""

WHOLE = 1.5
"""Multiple of the usual gap between a board's own reports above which one is missing."""


class Ways(Struct, frozen=True):
    """Counts of pulses: lost on the way `there`, and obeyed with the answer lost (`back`)."""

    sent: int
    there: int
    back: int


def finding(board: Board, operator: Operator, motors: Sequence[int]) -> Finding | None:
    """Judge the direction with motors that turn as commanded.

    Returns None if no line is known to be lost.
    """
    if not (board.own_clock or board.lost > loss.MOST):
        return None
    operator.say("the motors turn for a moment each time, to tell on which way lines are lost")
    ways = pulsed(board, motors) if motors else None
    if ways is None:
        return manual.find("lost where: untold")
    if ways.there + ways.back < loss.FEW:
        return manual.find("lost where: not seen", sent=ways.sent)
    outcome = "there" if ways.there > ways.back else "back"
    if min(ways.there, ways.back) >= loss.FEW:
        outcome = "both"
    seen = {"sent": ways.sent, "there": ways.there, "back": ways.back}
    return manual.find(f"lost where: {outcome}", None, **seen)


def pulsed(board: Board, motors: Sequence[int]) -> Ways | None:
    """Send pulses to these standing motors and count the losses.

    Returns None if the motors are too slow or too coarse to tell.
    """
    on = motion.each(lambda motor: limits.SPEED if motor in motors else 0.0)
    end_s = board.now_s + (OWN_CLOCK_S if board.own_clock else PULSES_S)
    every: list[float] = []
    unanswered: list[float] = []
    count = 0
    while len(unanswered) < TOLD and board.now_s < end_s:
        # An answer to an earlier line must not count for this one.
        board.listen(limits.GLANCE_S / 4)
        since_s, coasting = board.now_s, board.replies[-1].motors
        answered = bool(board.drive(on, PULSE_S, PULSE_S))
        board.drive(ZERO, 2 * board.gap_s + (4 + STRIDE * count % SPREAD) * board.period_s)
        if not _stand(board):
            return None
        count += 1
        if board.own_clock and not _whole(board, since_s):
            continue
        ran, passed_s = motion.covered(board.replies, since_s), board.now_s - since_s
        every.append(max(abs(ran[m]) - abs(coasting[m]) * passed_s for m in motors))
        if not (answered or board.own_clock):
            unanswered.append(every[-1])
    usual = median(every) if every else 0.0
    if usual < max(SEEN, GRAINS * _grain(board, motors)):
        return None
    if board.own_clock and len(every) < TOLD:
        return None
    if board.own_clock:
        return Ways(len(every), sum(angle < OBEYED * usual for angle in every), 0)
    back = sum(angle >= OBEYED * usual for angle in unanswered)
    return Ways(len(every), len(unanswered) - back, back)


def _whole(board: Board, since_s: float) -> bool:
    """Return whether none of the board's own reports since then is missing."""
    times = [reply.at_s for reply in motion.since(board.replies, since_s - board.gap_s)]
    return all(after - before < WHOLE * board.gap_s for before, after in pairwise(times))


def _grain(board: Board, motors: Sequence[int]) -> float:
    """Return the smallest angle that these encoders showed between two replies, rad."""
    course = motion.steps(board.replies)
    shown = [abs(step.speeds[m]) * step.seconds for step in course for m in motors]
    return min((angle for angle in shown if angle), default=0.0)


def _stand(board: Board) -> bool:
    """Wait until the motors stand. Return False if they are too slow for pulses."""
    began_s = board.now_s
    while board.turning():
        if board.now_s - began_s > limits.MOTOR_S / 2:
            board.rest()
            return False
        board.ask()
    return True
