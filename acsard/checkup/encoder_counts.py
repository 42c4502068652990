"""Finds the encoder counts per wheel turn, from the counts and the speeds in the replies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, median

from acsard.checkup import line_loss, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motion import SHORT_MEASUREMENT_S, BoardReply, steps

# Largest tolerated relative difference between the measured and the expected counts per turn.
MAX_COUNT_DIFFERENCE = 0.02

# Smallest to largest counts per turn; low, because coarse encoders are measured roughly.
MIN_COUNT_RATIO = 0.75

# From this variation of the angle per reply on, rad, the daemon must know the counts per turn.
COARSE_ANGLE = 0.015

# If replies are rarer, the acceleration of a motor makes the speed jump as a coarse encoder does.
MAX_REPLY_GAP_S = 0.05

MIN_READINGS = 20  # smallest number of nonzero reported speeds that can show a coarse encoder

MAX_COUNTS = 100_000  # largest value that `mcu.encoder_counts` accepts


def per_turn(replies: Sequence[BoardReply], motors: Sequence[int]) -> float | None:
    """Return the mean encoder counts per wheel turn of `motors` from the reported speeds.

    It is None if the motors turned too little, and negative if the counts fall at positive speeds.
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
    """Estimate the counts per turn of coarse encoders from the jumps of the reported speeds.

    For replies without counts. None if the encoders are not coarse, or if the replies are too few
    or too rare.
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
    """Return the finding about `mcu.encoder_counts`, by the replies of `motors`.

    If the board's identification also states a value, it must agree with the measurement.
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
        listing = ", ".join(
            f"{board.letters[motor]} {counts:.0f}" for motor, counts in each.items()
        )
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
