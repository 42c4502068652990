"""Prepares a log for the fit: cuts it into blocks, checks it and finds parameters to start from.

The checks decide whether the log can be used. They look at signs and units, at the agreement
between sensors and wheels, and at the amount of movement. If a log does not contain enough
movement, the message says what to drive.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration import heading, positions
from acsard.calibration.evidence import INVERSE_TRACK, LEFT, RIGHT, Base, condition
from acsard.calibration.fit import LEAST_BLOCKS, Fit, Multipliers, Source
from acsard.calibration.heading import Headings, Rows
from acsard.calibration.log_table import Floats
from acsard.calibration.plausibility import (
    RefusedError,
    distance_units,
    heading_follows,
    positions_follow,
    turn_rates,
    turn_units,
    turns_like_the_wheels,
    turns_the_right_way,
)  # fmt: skip
from acsard.calibration.positions import Segment, WheelSteps
from acsard.calibration.runs import Run
from acsard.calibration.search import search
from acsard.calibration.wheel_angles import Block, WheelAngles, blocks

LEAST_TURN = 2 * np.pi
"""Smallest total turn of the robot, rad."""

LEAST_ROLL = 3.0
"""Smallest angle by which the wheels must roll in all, rad.

Both the mean of the sides and half of their difference must reach it.
"""

ALIKE = 0.98
"""Squared correlation of the mean and the difference of both sides at which a log is refused.

Such a robot drives the same curve all the time.
"""

WORST = 0.2, 0.03
"""Largest useful standard deviations, as fractions: of the track, and of the ratio of the radii."""

WORST_CONDITION = 1e4
"""Largest condition number of the normal equations at which radii and track can be separated."""

DRIVE = (
    "drive 60 s: stand 3 s, 2 m straight ahead and back, three full turns to the left and three to "
    "the right, some of them slow and some fast, then curves both ways"
)


def drives_enough(parts: Sequence[Block]) -> None:
    """Raise `RefusedError` if the log has too few blocks in which the wheels turn."""
    if len(parts) < LEAST_BLOCKS:
        seconds = sum(part.end - part.begin for part in parts)
        raise RefusedError(f"the wheels turn for only {seconds:.0f} s, which is too short: {DRIVE}")


def rolls_enough(rows: Rows, *, spins: bool = False) -> None:
    """Raise `RefusedError` if the wheels lack a movement that the fit needs.

    Both sides must roll in opposite directions and in the same direction, and the proportion of the
    two movements must vary. If `spins` is true, turns on the spot are enough.
    """
    together, against = (rows.right + rows.left) / 2, (rows.right - rows.left) / 2
    for rolled, what in ((together, "ahead or back"), (against, "against each other")):
        if (turns := float(np.abs(rolled).sum()) / (2 * np.pi)) < LEAST_ROLL / (2 * np.pi):
            if spins and what == "ahead or back":
                continue
            raise RefusedError(
                f"the wheels roll {turns:.1f} turns {what} in all, which is too little to measure "
                f"their size, the ratio of left to right and the effective track: {DRIVE}"
            )
        cross = float(together @ against) ** 2
        if cross > ALIKE * float(together @ together) * float(against @ against):
            raise RefusedError(
                f"the robot always drives the same curve, which does not separate the wheels from "
                f"the track: {DRIVE}"
            )


def turns_enough(turned: Floats) -> None:
    """Raise `RefusedError` if the robot hardly turns. `turned` is the turn of each row, rad."""
    if (angle := float(np.abs(turned).sum())) < LEAST_TURN:
        raise RefusedError(
            f"the robot turned by {np.degrees(angle):.0f} deg in all, which is too little for the "
            f"effective track: {DRIVE}"
        )


TRACK, RATIO = "the effective track", "the ratio of left to right"
"""Names of the two quantities that a log may leave unsure."""


def unsure(
    found: Multipliers, track_std: float, worst: tuple[float, float] = WORST
) -> dict[str, float]:
    """Return the relative standard deviations that are too large to be useful, by name.

    The names are `TRACK` and `RATIO`.

    Args:
        found: the multipliers.
        track_std: the standard deviation of the track as a fraction. It leaves out that the track
            itself varies with the turn rate and from block to block.
        worst: the largest useful standard deviations of the track and of the ratio of the radii.
    """
    deviations = {TRACK: track_std, RATIO: found.ratio_std}
    return {
        name: deviation
        for (name, deviation), most in zip(deviations.items(), worst, strict=True)
        if not deviation <= most
    }


def separates_track(fitted: Fit) -> bool:
    """Return whether the log separates the radii from the track."""
    return condition(fitted.marginal()) <= WORST_CONDITION


class Prepared(Struct, frozen=True):
    """A log that was cut into blocks of one length, and the evidence that it gives."""

    parts: list[Block]
    rows: Rows
    """The turns. If the robot never rested, those of the gyro still contain the gyro's bias."""
    segments: list[Segment]
    """The positions; empty if the log has none."""
    steps: list[WheelSteps]
    """The wheel steps of each run; empty if the log has no positions."""
    sources: list[Source]
    start: Floats
    """The parameters from which the fit starts."""


def prepared(
    driven: Sequence[Run], angles: Sequence[WheelAngles], headings: Headings | None, base: Base,
    length: float,
) -> Prepared:  # fmt: skip
    """Cut the log into blocks of about `length` s, check it, and return it.

    Args:
        driven: the runs of the log.
        angles: the wheel angles of each run.
        headings: the headings by a sensor, or None.
        base: the configured geometry.
        length: the length of the blocks, s.

    Raises:
        RefusedError: the log cannot be used; the text says why and what to do.
    """
    parts = blocks(driven, angles, length)
    drives_enough(parts)
    count, start = len(parts), base.start()
    every = rows = heading.rows(headings, driven, angles, parts)
    if headings is not None and headings.bias_unknown and len(every.turned):
        rows = heading.level(every)
    if headings is not None and not len(rows.turned):
        raise RefusedError(
            f"{headings.source} has no samples while the wheels turn: record both at the same "
            "time, with times of one clock"
        )
    segments = positions.segments(driven, angles, parts)
    rolls_enough(rows, spins=headings is not None and not segments)
    steps = (
        [positions.wheel_steps(*pair) for pair in zip(driven, angles, strict=True)]
        if segments
        else []
    )
    sources: list[Source] = []
    sides = by_positions = None
    if headings is not None and len(rows.turned):
        turns_like_the_wheels(headings.source, rows.turned, rows, base)
        turns_enough(rows.turned)
        sides = heading.first(rows, base)
        heading_follows(headings.source, rows.turned, heading.by_sides(rows, base, sides))
        sources.append(lambda p: heading.evidence(rows, base, p, count))
    if segments:
        by_positions = search(segments, driven, angles, base, sides)
        positions_follow(by_positions)
        sources.append(
            lambda p: positions.evidence(
                segments, [positions.path(g, base, p) for g in steps], p, count
            )
        )
        start = by_positions.parameters.copy()
    if not sources:
        raise RefusedError(
            "there are no positions or turn rates while the robot drives: record both at the same "
            "time, with times of one clock"
        )
    turns_the_right_way(headings.source if headings else "", sides, by_positions)
    if sides is not None:
        mean, size = float(sides.mean()), float(start[[LEFT, RIGHT]].mean())
        start[[LEFT, RIGHT]] = size * sides / mean
        start[INVERSE_TRACK] = mean / size
    if headings is not None:
        turn_rates(headings.source, rows.turned, rows.seconds)
    _check_units(headings, start, base, by_positions is not None)
    return Prepared(parts, every, segments, steps, sources, start)


def _check_units(headings: Headings | None, start: Floats, base: Base, sized: bool) -> None:
    size, configured = float(start[[LEFT, RIGHT]].mean()), base.start()
    if sized:
        distance_units(size, base)
    bare = size * float(start[INVERSE_TRACK])
    turn = bare / float(configured[[LEFT, RIGHT]].mean() * configured[INVERSE_TRACK])
    turn_units(headings.source if headings else "", turn, bare, base)
