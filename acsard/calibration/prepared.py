"""A log cut into blocks, with the quantities to compare and the parameters to start from.

This module decides whether a log can be used at all: its signs and units, whether a sensor follows
the wheels, and whether there is enough of it.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.calibration import heading, places, turning
from acsard.calibration.doubts import (
    RefusedError,
    heading_follows,
    places_follow,
    turn_rates,
    turn_units,
    turns_the_right_way,
    way_units,
)  # fmt: skip
from acsard.calibration.evidence import LEFT, RIGHT, TURN, Base
from acsard.calibration.excitation import drives_enough, rolls_enough, turns_enough
from acsard.calibration.fit import Source
from acsard.calibration.heading import Headings, Rows
from acsard.calibration.paths import Block, Wheels, blocks
from acsard.calibration.places import Grid, Spots
from acsard.calibration.runs import Run
from acsard.calibration.search import search
from acsard.calibration.table import Floats


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
            f"{headings.source} tells nothing while the wheels turn: record both at the same time, "
            "with times of one clock"
        )
    rolls_enough(rows)
    spots = places.spots(driven, angles, parts)
    grids = [places.grid(*pair) for pair in zip(driven, angles, strict=True)] if spots else []
    sources: list[Source] = []
    sides = begun = None
    if headings is not None and len(rows.turned):
        turns_enough(rows.turned)
        sides = turning.first(rows, base)
        heading_follows(headings.source, rows.turned, turning.by_sides(rows, base, sides))
        sources.append(lambda p: turning.evidence(rows, base, p, count))
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
