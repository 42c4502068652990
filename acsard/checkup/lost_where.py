"""On which way lines are lost: to the board, or back.

Motors that stand are turned for a moment by a single line, again and again. One that was obeyed has
arrived, so it was the answer that got lost.
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
"""For so long a single line turns the motors: long enough for them, short for the watchdog."""

TOLD, PULSES_S = 8, 20.0
"""Lost pulses that tell the way, and how long they are waited for."""

OWN_CLOCK_S = 10.0
"""How long where nothing answers a line: there, nothing has said yet that any is lost."""

SPREAD, STRIDE = 12, 5
"""So many different times lie between the pulses, and not in their order: what is lost at intervals
would miss them all."""

OBEYED = 0.5
"""Of the angle that a pulse turns the motors by: it has arrived."""

SEEN, GRAINS = 0.02, 4
"""rad, and the least that the encoders show: motors that turn by less in a pulse tell nothing."""

WHOLE = 1.5
"""Times the usual time between two reports of a board's own clock: none is missing."""


class Ways(Struct, frozen=True):
    """What became of the pulses: lost on the way `there`; obeyed, and the answer lost (`back`)."""

    sent: int
    there: int
    back: int


def finding(board: Board, operator: Operator, motors: Sequence[int]) -> Finding | None:
    """By these motors, which turn as told; None where nothing is lost, as far as is known."""
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
    """Turn these motors, which stand; None when they are too slow to tell."""
    on = motion.each(lambda motor: limits.SPEED if motor in motors else 0.0)
    end_s = board.now_s + (OWN_CLOCK_S if board.own_clock else PULSES_S)
    every: list[float] = []
    unanswered: list[float] = []
    count = 0
    while len(unanswered) < TOLD and board.now_s < end_s:
        board.listen(limits.GLANCE_S / 4)  # an answer to an earlier line is none to this one
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
    """No report of the board's own is missing since then."""
    times = [reply.at_s for reply in motion.since(board.replies, since_s - board.gap_s)]
    return all(after - before < WHOLE * board.gap_s for before, after in pairwise(times))


def _grain(board: Board, motors: Sequence[int]) -> float:
    """rad; the least that these encoders have shown from one reply to the next."""
    course = motion.steps(board.replies)
    shown = [abs(step.speeds[m]) * step.seconds for step in course for m in motors]
    return min((angle for angle in shown if angle), default=0.0)


def _stand(board: Board) -> bool:
    """Wait until they stand; False when they are too slow for pulses."""
    began_s = board.now_s
    while board.turning():
        if board.now_s - began_s > limits.MOTOR_S / 2:
            board.rest()
            return False
        board.ask()
    return True
