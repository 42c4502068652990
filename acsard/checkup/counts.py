"""The sample fields against the speeds: encoder counts per wheel turn, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from acsard.checkup import manual, motion
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.limits import GLANCE_S
from acsard.checkup.motion import Reply

LEAST_ANGLE = 2.0
"""rad; over less the speeds' own rounding spoils the figure."""

AGREES = 0.02
"""By which share the measured counts may differ from those stated."""

MOST_COUNTS = 100_000
"""What `mcu.encoder_counts` takes."""


def per_turn(replies: Sequence[Reply], motors: Sequence[int]) -> float | None:
    """Counts per turn of these motors' encoders, by the speeds the MCU says; None: too little."""
    counts = angle = 0.0
    for before, after in pairwise(replies):
        leg = motion.leg(before, after)
        if leg is None or leg[1] > GLANCE_S:
            continue
        made, seconds = leg
        for motor in motors:
            speed = after.motors[motor]
            if abs(speed) >= 1.0:
                counts += math.copysign(1.0, speed) * made[motor]
                angle += abs(speed) * seconds
    return counts / angle * math.tau if angle >= LEAST_ANGLE else None


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """`mcu.encoder_counts`, from the identification or measured; `motors` have moved right."""
    if not board.sampled:
        return manual.find("encoder counts: none")
    measured, named = per_turn(board.replies, motors), board.named_counts
    configured = board.mcu.encoder_counts
    if measured is None:
        if not named:
            return manual.find("encoder counts: not turned")
        return _stated(configured, named, "by its identification; not measured")
    if measured < 1:
        return manual.find("encoder counts: backward", _off(configured), measured=measured)
    if not named:
        how = f"measured against its speeds, {measured:.0f} within {AGREES:.0%}"
        near = abs(measured - configured) <= AGREES * configured
        return _stated(configured, configured if near else round(measured), how)
    if abs(measured - named) <= AGREES * named:
        return _stated(configured, named, f"by its identification; measured {measured:.0f}")
    return manual.find("encoder counts: misnamed", named=named, measured=measured)


def _stated(configured: int, counts: int, how: str) -> Finding:
    if counts > MOST_COUNTS:
        many = "encoder counts: many"
        return manual.find(many, _off(configured), counts=counts, most=MOST_COUNTS)
    return manual.find(
        "encoder counts: right" if configured in (0, counts) else "encoder counts: wrong",
        {"mcu.encoder_counts": counts},
        counts=counts,
        configured=configured,
        how=how,
        off=abs(configured / counts - 1),
    )


def _off(configured: int) -> dict[str, object]:
    return {"mcu.encoder_counts": 0} if configured else {}
