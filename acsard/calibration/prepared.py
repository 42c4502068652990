"""A log cut into blocks, with the quantities to compare and the parameters to start from.

This module decides whether a log can be used at all: its signs and units, whether a sensor follows
the wheels, and whether there is enough of it. If a log does not contain enough movement, the advice
says what to drive.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration import heading, places
from acsard.calibration.doubts import (
    RefusedError,
    heading_follows,
    places_follow,
    turn_rates,
    turn_units,
    turns_the_right_way,
    way_units,
)  # fmt: skip
from acsard.calibration.evidence import LEFT, RIGHT, TURN, Base, condition
from acsard.calibration.fit import LEAST_BLOCKS, Multipliers, Source
from acsard.calibration.heading import Headings, Rows
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import Block, Wheels, blocks
from acsard.calibration.places import Grid, Spots
from acsard.calibration.runs import Run
from acsard.calibration.search import search

LEAST_TURN = 2 * np.pi
"""Smallest total turn of the robot, rad."""

LEAST_ROLL = 3.0
"""Smallest total roll of the wheels, rad, both in the same direction and against each other."""

ALIKE = 0.98
"""Squared correlation of both rolls above which they count as a single movement."""

WORST = 0.2, 0.03
"""Largest useful standard deviations, as fractions: of the track by chance, of the radii ratio."""

WORST_CONDITION = 1e4
"""Largest condition number of the scaled normal equations at which parameters can be told apart."""

DRIVE = (
    "drive 60 s: stand 3 s, 2 m straight ahead and back, three full turns to the left and three to "
    "the right, some of them slow and some fast, then curves both ways"
)


def drives_enough(parts: Sequence[Block]) -> None:
    """Raise `RefusedError` if the wheels hardly move at all."""
    if len(parts) < LEAST_BLOCKS:
        seconds = sum(part.end - part.begin for part in parts)
        raise RefusedError(f"the wheels turn for only {seconds:.0f} s, which is too short: {DRIVE}")


def rolls_enough(rows: Rows) -> None:
    """Raise `RefusedError` if the wheels lack a movement that the fit needs.

    They must roll together and against each other, and not always in the same proportion.
    """
    together, against = (rows.right + rows.left) / 2, (rows.right - rows.left) / 2
    for rolled, what in ((together, "ahead or back"), (against, "against each other")):
        if (turns := float(np.abs(rolled).sum()) / (2 * np.pi)) < LEAST_ROLL / (2 * np.pi):
            raise RefusedError(
                f"the wheels roll {turns:.1f} turns {what} in all, which is too little to measure "
                f"their size, the ratio of left to right and the effective track: {DRIVE}"
            )
    cross = float(together @ against) ** 2
    if cross > ALIKE * float(together @ together) * float(against @ against):
        raise RefusedError(
            f"the robot drives always the same circle, which measures nothing: {DRIVE}"
        )


def turns_enough(turned: Floats) -> None:
    """Raise `RefusedError` if the robot hardly turns. `turned` is in rad per row."""
    if (angle := float(np.abs(turned).sum())) < LEAST_TURN:
        raise RefusedError(
            f"the robot turned by {np.degrees(angle):.0f} deg in all, which is too little for the "
            f"effective track: {DRIVE}"
        )


def sure_enough(
    found: Multipliers, chance: float, worst: tuple[float, float] = WORST, log: str = "this log",
    mend: str = DRIVE,
) -> None:  # fmt: skip
    """Raise `RefusedError` if the result is too uncertain to be useful.

    `chance` is the standard deviation of the track as a fraction, without the track's own
    variation. `mend` is what to do then.
    """
    told = {"the effective track": chance, "the ratio of left to right": found.ratio_std}
    for (name, deviation), most in zip(told.items(), worst, strict=True):
        if not deviation <= most:
            raise RefusedError(
                f"{log} determines {name} only to {deviation:.1%}, which is too inaccurate: {mend}"
            )


def told_apart(normal: Floats) -> None:
    """Raise `RefusedError` if the log cannot separate the radii from the track.

    `normal` is the result of `Fit.apart`.
    """
    if condition(normal) > WORST_CONDITION:
        raise RefusedError(
            f"in the log the robot turns only while it drives ahead, so the track and the wheels "
            f"cannot be separated (condition number over {WORST_CONDITION:g}): {DRIVE}"
        )


class Prepared(Struct, frozen=True):
    """Blocks of one length and the quantities that are compared in them."""

    parts: list[Block]
    rows: Rows
    """Unchanged rows; if the gyro bias was not seen at rest, they still contain it."""
    spots: list[Spots]
    grids: list[Grid]
    sources: list[Source]
    start: Floats


def prepared(
    driven: Sequence[Run], angles: Sequence[Wheels], headings: Headings | None, base: Base,
    length: float,
) -> Prepared:  # fmt: skip
    """Cut the log into blocks of about `length` s and check it.

    Raises `RefusedError` for wrong signs or units, and if there is nothing to compare the wheels
    with.
    """
    parts = blocks(driven, angles, length)
    drives_enough(parts)
    count, start = len(parts), base.start()
    every = rows = heading.rows(headings, driven, angles, parts)
    if headings is not None and headings.drifts and len(every.turned):
        rows = heading.level(every)
    if headings is not None and not len(rows.turned):
        raise RefusedError(
            f"{headings.source} has no samples while the wheels turn: record both at the same "
            "time, with times of one clock"
        )
    rolls_enough(rows)
    spots = places.spots(driven, angles, parts)
    grids = [places.grid(*pair) for pair in zip(driven, angles, strict=True)] if spots else []
    sources: list[Source] = []
    sides = begun = None
    if headings is not None and len(rows.turned):
        turns_enough(rows.turned)
        sides = heading.first(rows, base)
        heading_follows(headings.source, rows.turned, heading.by_sides(rows, base, sides))
        sources.append(lambda p: heading.evidence(rows, base, p, count))
    if spots:
        begun = search(spots, driven, angles, base, sides)
        places_follow(begun)
        sources.append(
            lambda p: places.evidence(spots, [places.path(g, base, p) for g in grids], p, count)
        )
        start = begun.parameters.copy()
    if not sources:
        raise RefusedError(
            "there are no positions or turn rates while the robot drives: record both at the same "
            "time, with times of one clock"
        )
    turns_the_right_way(headings.source if headings else "", sides, begun)
    if sides is not None:
        mean, size = float(sides.mean()), float(start[[LEFT, RIGHT]].mean())
        start[[LEFT, RIGHT]] = size * sides / mean
        start[TURN] = mean / size
    if headings is not None:
        turn_rates(headings.source, rows.turned, rows.seconds)
    _units(headings, start, base, begun is not None)
    return Prepared(parts, every, spots, grids, sources, start)


def _units(headings: Headings | None, start: Floats, base: Base, sized: bool) -> None:
    size, was = float(start[[LEFT, RIGHT]].mean()), base.start()
    if sized:
        way_units(size, base)
    bare = size * float(start[TURN])
    turn = bare / float(was[[LEFT, RIGHT]].mean() * was[TURN])
    turn_units(headings.source if headings else "the positions' yaw", turn, bare, base)
