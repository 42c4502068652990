"""What is wrong with a log rather than with a robot: signs, sides, units, times.

What would lead astray is refused, with what it may be; what was allowed for is told.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from acsard.calibration.evidence import LEFT, RIGHT, TURN, Base
from acsard.calibration.search import Begin
from acsard.calibration.table import Floats
from acsard.values import AcsardError

UNLIKE = 0.5
"""Share of what a sensor shows that the wheels may leave unexplained."""

UNITS = 8.0
"""Times too much or too little that only another unit explains."""

LEAST_TURN = 0.2
"""Times as far as the configured wheels say: less is not of a robot that skids, but rpm."""

FAR_SIZE = 2e-3
"""So little no other unit of the wheels makes of a way."""

FASTEST_TURN = 12.0
"""rad/s; who turns twice a second drives no odometry: that is in degrees."""

LEAST_CHI = 0.4
"""Effective over configured track: wheels that skid make it larger, never so much smaller."""

LEAST_FACTOR, MOST_FACTOR = 0.1, 10.0
"""What a multiplier may be."""


NOTABLE_S, FAR_S = 0.005, 0.5
LARGE_BIAS = 0.05
"""rad/s"""
ONE_SIDED = 0.1
"""Share of the turns that must be to the lesser side."""
ODD_SIZE = 1.25
LEAST_TRACK, MOST_TRACK = 0.85, 3.0
"""Times the configured size: what lies beyond is told."""


class RefusedError(AcsardError):
    """The log cannot be calibrated with; the text says why and what to do."""


class UnlikeError(RefusedError):
    """Positions do not follow the wheels, over blocks as long as these."""


def heading_follows(source: str, turned: Floats, by_wheels: Floats) -> None:
    """The sensor shows the turns of the wheels, whatever sign; raises `RefusedError`."""
    spread = float(turned @ turned)
    if not spread or float(np.sum((turned - by_wheels) ** 2)) > UNLIKE * spread:
        raise RefusedError(
            f"{source} does not follow what the wheels do: is it of the upright axis (yaw, not "
            "roll or pitch), of the same drive, on the same clock within 2 s, and did the wheels "
            "touch the ground? And are the wheels' columns speeds, not angles?"
        )


def places_follow(begun: Begin) -> None:
    """The positions show the path of the wheels; raises `RefusedError`."""
    if begun.unexplained > UNLIKE:
        raise UnlikeError(
            "the positions do not follow what the wheels do: are they x ahead and y to the left in "
            "m (not latitude and longitude), of the same drive, on the same clock within 1 s?"
        )


def turns_the_right_way(source: str, sides: Floats | None, begun: Begin | None) -> None:
    """The signs of all agree; raises `RefusedError` with what is the wrong way round.

    `sides`: g_l and g_r of the heading sensor `source`; `begun`: the best start for positions.
    """
    left = right = 1.0
    if begun is not None:
        left, right = np.sign(begun.parameters[[LEFT, RIGHT]] * begun.parameters[TURN])
    by_places = {(1.0, 1.0): "", (-1.0, -1.0): "turn", (-1.0, 1.0): "left"}.get(
        (left, right), "right"
    )
    by_heading = by_places
    if sides is not None:
        by_heading = {(True, True): "", (False, False): "turn", (False, True): "left"}.get(
            (bool(sides[0] > 0), bool(sides[1] > 0)), "right"
        )
    for side in ("left", "right"):
        if side in (by_heading, by_places):
            raise RefusedError(
                f"the {side} wheels turn backwards when the robot goes ahead: their speeds have "
                "the wrong sign; rad/s are positive ahead on both sides"
            )
    if sides is not None and begun is not None and by_heading != by_places:
        other = "x and y are swapped, or y is positive to the right"
        sign = f"{source} has the wrong sign (it must be positive to the left)"
        raise RefusedError(
            f"wheels and positions agree on the side the robot turns to, {source} does not: {sign}"
            if by_heading
            else f"wheels and {source} agree on the side the robot turns to, positions do not: "
            f"{other}"
        )
    if by_heading:
        seen = source or "the positions"
        also = "" if begun is not None and sides is not None else _ALSO[sides is not None]
        raise RefusedError(
            f"by {seen} the robot turns to the other side than by the wheels: the columns of left "
            f"and right are swapped, or ahead is negative on both sides{also}"
        )


_ALSO = {
    True: ", or the sensor is positive to the right (it must be positive to the left)",
    False: ", or x and y are swapped, or y is positive to the right",
}


def turn_rates(source: str, turned: Floats, seconds: Floats) -> None:
    """A robot can turn so fast; raises `RefusedError` for degrees. `turned`: rad in each row.

    Where the wheels are in another unit too, one may hide the other.
    """
    rate = float(np.percentile(np.abs(turned) / seconds, 90))
    if rate > FASTEST_TURN:
        raise RefusedError(
            f"{source} is in degrees (multiply by pi / 180): it shows turns of {rate:.0f} rad/s; "
            "and see that the wheel speeds are in rad/s, not deg/s, rpm or mm/s"
        )


def turn_units(source: str, turn: float, bare: float, base: Base) -> None:
    """The robot turns about as far as the wheels say; raises `RefusedError` for other units.

    `turn`: what it turns, over what the configured wheels and track say; `bare`: over what wheel
    radius and separation say.
    """
    if LEAST_TURN < turn < UNITS and bare < 1 / LEAST_CHI:
        return
    may = (
        f"{source} is in degrees (multiply by pi / 180), or the wheel speeds are in m/s (divide "
        "by the wheel radius) or turns/s (multiply by 2 pi)"
        if turn > 1
        else "the wheel speeds are in deg/s, rpm or counts, or are angles (rad/s are needed)"
    )
    raise RefusedError(
        f"the robot turns {turn:.3g} times as far as its wheels say: {may}, or drive.wheel_radius "
        f"= {base.radius:g} and drive.wheel_separation = {base.separation:g} are another robot's "
        "(--config)"
    )


def way_units(size: float, base: Base) -> None:
    """It goes about as far; raises `RefusedError` for other units. `size`: radius over the
    configured one."""
    if 1 / UNITS < size < UNITS:
        return
    may = (
        "the wheel speeds are in m/s (divide by the wheel radius), or the positions in mm or cm"
        if size > 1
        else "the positions are latitude and longitude, or in km (x ahead and y to the left, in m, "
        "are needed)"
        if size < FAR_SIZE
        else "the wheel speeds are in deg/s, rpm or counts, or are angles (rad/s are needed)"
    )
    raise RefusedError(
        f"the robot goes {size:.3g} times as far as its wheels say: {may}, or drive.wheel_radius "
        f"= {base.radius:g} is another robot's (--config)"
    )


def in_range(values: Floats) -> None:
    """The multipliers can be written; raises `RefusedError`."""
    if np.all((values >= LEAST_FACTOR) & (values <= MOST_FACTOR)):
        return
    shown = ", ".join(f"{value:.3g}" for value in values)
    raise RefusedError(
        f"the multipliers come out as {shown} (wheel separation, left, right), which must be from "
        f"{LEAST_FACTOR:g} to {MOST_FACTOR:g}: put the measured drive.wheel_radius and "
        "drive.wheel_separation into the configuration first"
    )


def remarks(
    late: dict[str, float], bias: float, turned: Floats, values: Floats, base: Base, *, sized: bool
) -> Iterator[str]:
    """What is unusual but was allowed for, a sentence each."""
    for source, seconds in late.items():
        if abs(seconds) >= NOTABLE_S:
            word = "later" if seconds > 0 else "earlier"
            far = "; set the clocks" if abs(seconds) > FAR_S else ""
            yield (
                f"the times of {source} are {abs(seconds) * 1000:.0f} ms {word} than those of the "
                f"wheels; this was allowed for{far}"
            )
    if abs(bias) > LARGE_BIAS:
        yield f"the gyro turns by {bias:.3f} rad/s while the robot stands: allowed for, but much"
    left, right = float(turned[turned > 0].sum()), float(-turned[turned < 0].sum())
    if min(left, right) < ONE_SIDED * max(left, right):
        yield "nearly all turns are to one side: what differs between the sides is not seen"
    size = float(values[1:].mean())
    if sized and not 1 / ODD_SIZE < size < ODD_SIZE:
        yield (
            f"the wheels come out {size:.3g} times as large as drive.wheel_radius = "
            f"{base.radius:g}: measure it, and see that wheel speeds are in rad/s and x, y in m"
        )
    track = float(values[0])
    if not LEAST_TRACK < track < MOST_TRACK:
        yield (
            f"an effective track of {track:.3g} times drive.wheel_separation = "
            f"{base.separation:g} is unusual (1 to 2.5 is usual): measure it, and see that all "
            "units are right"
        )
