"""Measures how often the microcontroller answers, whether by its own clock, and how soon."""

from __future__ import annotations

from itertools import pairwise
from statistics import fmean, median

from acsard.checkup import lateness, manual
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.limits import CUT_S, GLANCE_S
from acsard.checkup.motion import ZERO
from acsard.config.wire_time import COMFORTABLE_USE, highest_rate, line_bytes

ENOUGH = 10
"""Number of replies that is enough for a rate."""

ANSWERED = 0.8
"""Fraction of answered lines below which lines are lost or remain unanswered."""

SLOW_S = 0.008
"""Round trip in addition to the lines' time on the wire that delays the control loop, s.

An MCU usually takes 1 to 5 ms.
"""

TRIPS = 10


def rate(board: Board) -> Finding:
    """Measure how often the board answers at the host's rate, and whether it reports unasked."""
    board.paced = True
    board.listen(GLANCE_S / 4)
    unasked = board.listen(CUT_S)
    # Lines that were delayed here or at the board all arrive at once, so they span no time.
    board.own_clock = bool(unasked) and unasked[-1].at_s - unasked[0].at_s > GLANCE_S
    highest_hz = highest_rate(board.baud_rate, line_bytes(board.comma), COMFORTABLE_USE)
    period_s, before = 1 / min(board.rate_hz, highest_hz), board.sent_lines
    got = board.drive(ZERO, 0.5, period_s)
    if len(got) < ENOUGH:
        got += board.drive(ZERO, 1.0, period_s)
    if len(got) < 2:
        return manual.find("reply rate: none")
    gaps = [after.at_s - one.at_s for one, after in pairwise(got)]
    board.gap_s = gap_s = fmean(gaps)
    configured, answered = board.mcu.reply_period, len(got) / (board.sent_lines - before)
    unset_s = max(0.1, 4 * period_s)  # the silence that the host allows by default
    quiet_s = max(unset_s, 3 * configured)
    slow, lossy = 3 * gap_s > 1.1 * quiet_s, not board.own_clock and answered < ANSWERED
    most_s = board.longest_reply_s
    rare, period = slow and gap_s > most_s, min(float(f"{gap_s:.1g}"), most_s)
    keys: dict[str, object] = {"mcu.reply_period": period if slow else configured}
    outcome = "rare" if rare else "slow" if slow else "lossy" if lossy else "right"
    return manual.find(
        f"reply rate: {outcome}",
        keys if 3 * gap_s > 1.1 * unset_s and not rare else {},
        rate=1 / gap_s,
        way="by its own clock" if board.own_clock else "when spoken to",
        longest=max(gaps) * 1000,
        answered=answered,
        gap=gap_s * 1000,
        quiet=quiet_s * 1000,
        period=period,
        most=most_s,
    )


def trip(board: Board) -> Finding:
    """Measure how soon a line is answered."""
    if not board.paced:
        return lateness.finding("round trip", board.lateness.since(0.0))
    if board.own_clock:
        return manual.find("round trip: own clock")
    trips = [trip_s for trip_s, _ in board.answers(TRIPS, GLANCE_S)]
    if not trips:
        return manual.find("round trip: none")
    middle_s, longest_s = median(trips), max(trips)
    pace = "slow" if middle_s > SLOW_S + 2 * board.line_s else "right"
    return manual.find(f"round trip: {pace}", middle=middle_s * 1000, longest=longest_s * 1000)
