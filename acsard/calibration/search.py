"""Finds parameters from which the fit to positions can start.

The Gauss-Newton fit needs a track that is nearly right. The search tries tracks from a tenth to
thirty times the configured one, with turns to either side and with one side of the wheels reversed.
For each of them, the size of the path gives the radius.

A turn on the spot moves no position. Positions therefore often determine such a turn only up to
whole turns: 90 deg to the left end like 270 deg to the right. If several starting points explain
the positions about as well, the one of the more usual robot is chosen.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration import positions
from acsard.calibration.fit import DELAY, INVERSE_TRACK, LEFT, RIGHT, Base, Evidence, fit
from acsard.calibration.log_table import Floats
from acsard.calibration.positions import Segment, WheelSteps, place, wheel_steps
from acsard.calibration.runs import Run

TURNS = np.unique(np.concatenate((np.geomspace(0.03, 10.0, 60), np.geomspace(0.28, 1.4, 40))))
"""Ratios of configured to true track that are tried. They are finer in the usual range."""

DELAYS = np.arange(-1.5, 1.55, 0.1)
"""Delays of the positions that are tried, s."""

MOST_SEGMENTS, REFINED_SEGMENTS = 60, 20
"""Number of segments that are used to try and to refine: those with the longest reach.

A search needs no more of them.
"""

MOST_POINTS = 80
"""Approximate number of positions per segment that are used, evenly spaced."""

MOST_REFINED, FAR_WORSE = 4, 20.0
"""Number of starting points to refine, and how many times worse than the best each may be."""

USUAL_TURN = 0.31, 1.25
"""Usual ratios of the robot's turn to the turn by its wheels and the wheel separation.

The lowest is that of a robot that skids much, the highest that of a robot that does not skid.
"""

NEAR_HEADING = 0.8, 1.25
"""Usual ratios of the robot's turn by positions to the turn by a heading sensor."""

WRONG_WAY = 4.0
"""Factor by which the unexplained part of an unusual robot is multiplied.

Such a robot has one side reversed, or turns to the other side than its wheels.
"""

NOTHING = 1e-3
"""Part of the positions' spread below which differences between starting points mean nothing.

It is the noise of positions, which no starting point explains.
"""

STRAYED = 1.3
"""Factor by which the turn may change during refinement. Beyond it, the refinement is not used."""

COARSE_S = 0.1
"""Time step in which paths are summed during the search, s."""


class StartingPoint(Struct, frozen=True):
    """Parameters from which a fit can start."""

    parameters: Floats
    unexplained: float
    """Part of the positions' spread, as squares, that the path of the wheels leaves unexplained."""


def search(
    segments: Sequence[Segment], driven: Sequence[Run], base: Base, sides: Floats | None = None
) -> StartingPoint:
    """Return the best starting point for these positions.

    `sides` is the result of `heading.first`, or None without a heading sensor.
    """
    kept = _furthest(segments, MOST_SEGMENTS)
    needed = sorted({segment.run for segment in kept})
    steps = {run: wheel_steps(driven[run], COARSE_S) for run in needed}
    points: list[StartingPoint] = []
    for left, way in itertools.product((1.0, -1.0), (1.0, -1.0)):
        points += _local_minima(
            [_tried(kept, steps, base, (left, way * turn, 0.0)) for turn in TURNS]
        )
    if sides is not None:
        left, way = np.sign(sides[0] * sides[1]), np.sign(sides[1]) * np.abs(sides).mean()
        points.append(_tried(kept, steps, base, (float(left), float(way), 0.0)))

    def badness(point: StartingPoint) -> float:
        return (point.unexplained + NOTHING) * _penalty(point, sides)

    points.sort(key=badness)
    few, worst = _furthest(kept, REFINED_SEGMENTS), FAR_WORSE * badness(points[0])
    refined = [
        _refined(_timed(point, few, steps, base), few, steps, base)
        for point in points[:MOST_REFINED]
        if badness(point) <= worst
    ]
    return min(refined, key=badness)


def _furthest(segments: Sequence[Segment], most: int) -> list[Segment]:
    reach = [float(np.ptp(s.place.real) + np.ptp(s.place.imag)) for s in segments]
    kept = [segments[i] for i in sorted(np.argsort(reach)[::-1][:most])]
    return [
        replace(s, t=s.t[:: 1 + len(s.t) // MOST_POINTS],
                place=s.place[:: 1 + len(s.t) // MOST_POINTS])
        for s in kept
    ]  # fmt: skip


def _local_minima(tried: Sequence[StartingPoint]) -> list[StartingPoint]:
    """Return the starting points that leave no more unexplained than both of their neighbours."""
    left = [np.inf, *(point.unexplained for point in tried), np.inf]
    return [p for at, p in enumerate(tried) if p.unexplained <= min(left[at], left[at + 2])]


def _penalty(point: StartingPoint, sides: Floats | None) -> float:
    """Return a factor of at least 1, which is larger for a less usual robot."""
    signed = point.parameters[[LEFT, RIGHT]] * point.parameters[INVERSE_TRACK]
    turn, (least, most) = float(np.abs(signed).mean()), USUAL_TURN
    like = np.ones(2)
    if sides is not None:
        turn, like = turn / max(1e-9, float(np.abs(sides).mean())), np.sign(sides)
        least, most = NEAR_HEADING
    beyond = max(0.0, np.log(least / turn), np.log(turn / most))
    return (1.0 if np.array_equal(np.sign(signed), like) else WRONG_WAY) * float(1.0 + 2.0 * beyond)


def _turn(parameters: Floats) -> float:
    """Return the robot's turn for a roll of the right wheels alone, relative to `Base.gain`."""
    return float(parameters[INVERSE_TRACK] * parameters[RIGHT])


def _timed(
    point: StartingPoint, kept: Sequence[Segment], steps: dict[int, WheelSteps], base: Base
) -> StartingPoint:
    """Return the starting point with the delay of the positions that suits it best."""
    parameters = point.parameters
    shape = float(np.sign(parameters[LEFT])), float(parameters[INVERSE_TRACK] * parameters[RIGHT])
    tried = [_tried(kept, steps, base, (*shape, late)) for late in DELAYS]
    return min([point, *tried], key=lambda point: point.unexplained)


def _tried(
    kept: Sequence[Segment],
    steps: dict[int, WheelSteps],
    base: Base,
    shape: tuple[float, float, float],
) -> StartingPoint:
    """Return the starting point for a shape of the path.

    `shape` has the sign of the left side, the ratio of configured to true track, and the delay of
    the positions in s.
    """
    parameters = base.start()
    parameters[[LEFT, RIGHT, INVERSE_TRACK, DELAY]] = shape[0], 1.0, shape[1], shape[2]
    paths = {run: place(of_run, base, parameters) for run, of_run in steps.items()}
    cross = spread = size = 0.0
    for segment in kept:
        path = np.interp(segment.t - shape[2], steps[segment.run].t, paths[segment.run])
        centred, centred_path = segment.place - segment.place.mean(), path - path.mean()
        # Each path is rotated in the best way; all share one scale.
        cross += abs(complex(np.vdot(centred_path, centred)))
        size += float(np.sum(np.abs(centred_path) ** 2))
        spread += float(np.sum(np.abs(centred) ** 2))
    if not size or not spread:
        return StartingPoint(parameters, np.inf)
    scale = cross / size
    parameters[[LEFT, RIGHT]] *= scale
    parameters[INVERSE_TRACK] /= scale
    return StartingPoint(parameters, 1.0 - cross**2 / (size * spread))


def _refined(
    point: StartingPoint, few: Sequence[Segment], steps: dict[int, WheelSteps], base: Base
) -> StartingPoint:
    """Return the starting point after a fit to a few segments.

    The fit also finds where on the robot the positions are measured, and outliers count less.
    """
    segments = [replace(segment, block=number) for number, segment in enumerate(few)]

    def evidence(parameters: Floats) -> Evidence:
        return positions.evidence(segments, paths(parameters), parameters, len(segments))

    def paths(parameters: Floats) -> dict[int, positions.Path]:
        return {run: positions.path(of_run, base, parameters) for run, of_run in steps.items()}

    def unexplained(parameters: Floats) -> float:
        spread = sum(float(np.sum(np.abs(s.place - s.place.mean()) ** 2)) for s in segments)
        off = positions.spread(segments, paths(parameters), parameters)
        return off**2 * sum(len(s.t) for s in segments) / spread if spread else np.inf

    before = StartingPoint(point.parameters, unexplained(point.parameters))
    if not np.isfinite(before.unexplained):
        return point
    parameters = fit([evidence], point.parameters, places=True).parameters
    moved = _turn(parameters) / _turn(point.parameters)
    if not 1 / STRAYED < moved < STRAYED:
        return before  # the data does not determine the turn there
    after = StartingPoint(parameters, unexplained(parameters))
    return min([before, after], key=lambda point: point.unexplained)
