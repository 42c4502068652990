"""Finds the encoder counts per wheel turn, from the counts and the speeds in the replies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, median

from acsard.checkup import line_loss, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motion import SHORT_MEASUREMENT_S, BoardReply, steps
from acsard.core.link.codec import LETTERS

MAX_COUNT_DIFFERENCE = 0.02
"""Largest tolerated relative difference between the measured and the expected counts per turn.

The configuration or the firmware states the expected number.
"""

MIN_COUNT_RATIO = 0.75
"""Smallest tolerated ratio of the smallest to the largest counts per turn of the encoders.

The limit is low, because a coarse encoder allows only a rough measurement.
"""

COARSE_ANGLE = 0.015
"""Limit from which on encoders count as coarse, rad.

The limit applies to the mean variation of the angle by which a wheel turns from one reply to the
next. The daemon must know the counts per turn of a coarse encoder.
"""

MAX_REPLY_GAP_S = 0.05
"""Longest time from one reply to the next in a search for coarse encoders, s.

A coarse encoder makes the reported speed jump. If replies are rarer, the acceleration of a motor
causes similar jumps.
"""

MIN_READINGS = 20
"""Smallest number of nonzero reported speeds that can show a coarse encoder."""

MAX_COUNTS = 100_000
"""Largest value that `mcu.encoder_counts` accepts."""


def per_turn(replies: Sequence[BoardReply], motors: Sequence[int]) -> float | None:
    """Return the mean number of encoder counts per wheel turn of `motors` (numbers 0 to 3).

    The number of turns is computed from the reported speeds. Return None if the motors turned too
    little. The result is negative if the counts fall while the reported speeds are positive.
    """
    counts = angle = 0.0
    for step in steps(replies):
        if step.counts is None or step.mcu_s > SHORT_MEASUREMENT_S:
            continue
        for motor in motors:
            speed = step.speeds[motor]
            if abs(speed) >= 1.0:
                counts += math.copysign(1.0, speed) * step.counts[motor]
                angle += abs(speed) * step.mcu_s
    # Below 2 rad, the rounding of the reported speeds makes the result too inaccurate.
    return counts / angle * math.tau if angle >= 2.0 else None


def coarse(replies: Sequence[BoardReply], motors: Sequence[int]) -> float | None:
    """Estimate the counts per wheel turn of coarse encoders from the jumps of the reported speeds.

    A coarse encoder has few counts per turn, so its reported speed jumps at each count. This
    function is for replies that contain no counts. `motors` are numbers from 0 to 3. Return None if
    the encoders are not coarse, if too few replies contain a speed other than 0, or if the replies
    are too rare (`MAX_REPLY_GAP_S`).
    """
    course = [step for step in steps(replies) if 0.0 < step.seconds <= SHORT_MEASUREMENT_S]
    # Use the median, because the arrival time of a single reply is wrong if this computer is late.
    period = median([step.seconds for step in course] or [math.inf])
    if period > MAX_REPLY_GAP_S:
        return None
    jumps, angles = [], []
    for motor in motors:
        speeds = [abs(step.speeds[motor]) for step in course]
        angles += [abs(s.speeds[motor]) * s.seconds for s in course if s.speeds[motor]]
        for first, second, third in zip(speeds, speeds[1:], speeds[2:], strict=False):
            if first or second or third:
                jumps.append(abs(first - 2 * second + third) / 2 * period)
    if len(angles) < MIN_READINGS or fmean(jumps) < COARSE_ANGLE:
        return None
    least = sorted(angles)[len(angles) // 20]
    return math.tau / fmean([angle for angle in angles if angle <= 1.5 * least])


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Return the finding about `mcu.encoder_counts`, the configured counts per wheel turn.

    The configured value is compared with the value that is measured from the replies. If the
    board's identification also states a value, that value must agree with the measurement. `motors`
    are the numbers of the motors that turned as commanded.
    """
    if not board.sampled:
        about = coarse(board.replies, motors)
        if about is None or board.mcu.encoder_counts:
            return outcomes.find("encoder counts: none")
        return outcomes.find("encoder counts: coarse", about=about)
    if board.lost > line_loss.MAX_LOSS:
        return outcomes.find("encoder counts: damaged", share=board.lost)
    text = board.identity.get("counts", "")
    named = int(text) if text.isdigit() and len(text) < 9 else 0
    measured, configured = per_turn(board.replies, motors), board.mcu.encoder_counts
    unused: dict[str, object] = {"mcu.encoder_counts": 0} if configured else {}
    if measured is None and not named:
        return outcomes.find("encoder counts: not turned")
    # The mean over all motors may look right although the counts of a single motor are wrong.
    single = {motor: per_turn(board.replies, [motor]) for motor in motors}
    each = {motor: counts for motor, counts in single.items() if counts is not None}
    if wrong := [motor for motor, counts in each.items() if counts < 1]:
        names, least = motor_names(board.mcu, wrong), min(each.values())
        return outcomes.find("encoder counts: backward", unused, names=names, measured=least)
    if each and min(each.values()) < MIN_COUNT_RATIO * max(each.values()):
        listing = ", ".join(f"{LETTERS[motor]} {counts:.0f}" for motor, counts in each.items())
        return outcomes.find("encoder counts: unequal", unused, shown=listing)
    if measured is None:
        counts, how = named, "the firmware states this number; the check could not measure it"
    elif not named:
        near = abs(measured - configured) <= MAX_COUNT_DIFFERENCE * configured
        if board.lost and not near:
            return outcomes.find("encoder counts: damaged", share=board.lost)
        counts = configured if near else round(measured)
        how = (
            f"the counts and speeds in the replies give {measured:.0f} counts per wheel turn; the "
            f"check accepts a configured number that differs by up to {MAX_COUNT_DIFFERENCE:.0%}"
        )
    elif abs(measured - named) > MAX_COUNT_DIFFERENCE * named:
        return outcomes.find("encoder counts: misnamed", named=named, measured=measured)
    else:
        counts, how = named, f"the firmware states this number; the check measured {measured:.0f}"
    if counts > MAX_COUNTS:
        return outcomes.find("encoder counts: many", unused, counts=counts, most=MAX_COUNTS)
    right = configured in (0, counts)
    # The daemon divides the counts by the configured number to get the turns of a wheel.
    off = abs(counts / configured - 1) if configured else 0.0
    return outcomes.find(
        "encoder counts: right" if right else "encoder counts: wrong",
        {"mcu.encoder_counts": counts},
        counts=counts,
        configured=configured,
        how=how,
        off=off,
    )
