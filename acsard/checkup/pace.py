"""How often the microcontroller answers while lines go out, of itself, and how soon."""

from __future__ import annotations

from itertools import pairwise
from statistics import fmean, median

from acsard.checkup import manual, motion
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.limits import CUT_S, GLANCE_S
from acsard.checkup.motion import ZERO
from acsard.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes

ENOUGH = 10
"""Replies for a figure."""

ANSWERED = 0.8
"""Share of the lines; where less come back, some are lost or not answered."""

SLOW_S = 0.008
"""A round trip longer than the lines' time on the wire and this holds the control loop's news
back; an MCU takes 1 to 5 ms."""

TRIPS = 10


def rate(board: Board) -> Finding:
    """How often it answers at the host's pace, and whether by itself."""
    board.listen(GLANCE_S / 4)
    board.own_clock = len(board.listen(CUT_S)) >= 2
    highest_hz = highest_rate(board.baud_rate, line_bytes(board.comma), COMFORTABLE_USE)
    period_s = max(1 / board.rate_hz, 1 / highest_hz)
    before = board.sent_lines
    got = board.drive(ZERO, 0.5, period_s)
    if len(got) < ENOUGH:
        got += board.drive(ZERO, 1.0, period_s)
    gaps = [after.at_s - one.at_s for one, after in pairwise(got)]
    if not gaps:
        return manual.find("reply rate: none")
    board.gap_s = fmean(gaps)
    return _judged(board, period_s, max(gaps), len(got) / (board.sent_lines - before))


def _judged(board: Board, period_s: float, longest_s: float, answered: float) -> Finding:
    configured = board.mcu.reply_period
    unset_s = max(0.1, 4 * period_s)
    quiet_s = max(unset_s, 3 * configured)
    period = float(f"{board.gap_s:.1g}")
    keys: dict[str, object] = {}
    if 3 * board.gap_s > 1.1 * unset_s:
        keys = {"mcu.reply_period": configured}
    if 3 * board.gap_s > 1.1 * quiet_s:
        outcome, keys = "slow", {"mcu.reply_period": period}
    elif not board.own_clock and answered < ANSWERED:
        outcome = "lossy"
    else:
        outcome = "right"
    return manual.find(
        f"reply rate: {outcome}",
        keys,
        rate=1 / board.gap_s,
        way="by its own clock" if board.own_clock else "when spoken to",
        longest=longest_s * 1000,
        answered=answered,
        gap=board.gap_s * 1000,
        quiet=quiet_s * 1000,
        period=period,
    )


def trip(board: Board) -> Finding:
    """How soon a line is answered."""
    if board.own_clock:
        return manual.find("round trip: own clock")
    board.listen(GLANCE_S)
    trips: list[float] = []
    for _ in range(TRIPS):
        board.ask(ZERO, GLANCE_S)  # no reply to an earlier line may be taken for this one's
        answer = motion.since(board.replies, board.sent_s)[:1]
        trips += [reply.at_s - board.sent_s for reply in answer]
    if not trips:
        return manual.find("round trip: none")
    middle_s = median(trips)
    slow = middle_s > SLOW_S + 2 * board.line_s
    return manual.find(
        "round trip: slow" if slow else "round trip: right",
        middle=middle_s * 1000,
        longest=max(trips) * 1000,
    )
