"""Finds a starting point for positions, because Gauss-Newton needs a nearly correct track.

It tries tracks from a tenth to thirty times the configured one, with both signs of the turn and
with one side reversed. The size of the resulting path gives the radius.

Positions alone often determine a turn in place only up to whole turns: 90 deg to the left end like
270 deg to the right. Among starting points that explain about as much, the more likely robot wins.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration import places
from acsard.calibration.evidence import LATE, LEFT, RIGHT, TURN, Base, Evidence
from acsard.calibration.fit import fit
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import Wheels
from acsard.calibration.places import Grid, Spots, grid, place
from acsard.calibration.runs import Run

TURNS = np.unique(np.concatenate((np.geomspace(0.03, 10.0, 60), np.geomspace(0.28, 1.4, 40))))
"""Ratios of configured to true track that are tried. They are finer in the usual range.

They apply to wheels of the configured radius.
"""

DELAYS = np.arange(-1.5, 1.55, 0.1)
"""Delays of positions that are tried, s."""

MOST_SPOTS, SETTLED_SPOTS = 60, 20
"""Number of blocks that are used, those with the longest reach first.

This is a search, not a fit.
"""

MOST_POINTS = 80
"""Number of positions per block that are used, evenly spaced."""

MOST_BEGUN, FAR_WORSE = 4, 20.0
"""Number of starting points that are refined, and how much worse than the best they may be."""

USUAL_TURN, NEAR_HEADING = (0.31, 1.25), (0.8, 1.25)
"""Usual ratios of the robot's turn to that of another source: lowest and highest.

`USUAL_TURN` is relative to the wheels and the wheel separation, from skid-steer to no skidding.
`NEAR_HEADING` is relative to a heading sensor.
"""

WRONG_WAY = 4.0
"""Penalty for a robot with a reversed side, or one that turns to the other side.

A correct robot must leave this many times more unexplained before the reversed one is believed.
"""

NOTHING = 1e-3
"""Fraction of the positions' spread that cannot distinguish starting points.

Any starting point explains short straights except for their noise.
"""

STRAYED = 1.3
"""Factor by which the turn may change during refinement. Beyond it, the result is not used."""

COARSE_S = 0.1
"""Time step in which the paths are summed here, s."""


class Begin(Struct, frozen=True):
    """A starting point; `unexplained` is the fraction of the positions' spread that it leaves."""

    parameters: Floats
    unexplained: float


def search(
    found: Sequence[Spots], driven: Sequence[Run], angles: Sequence[Wheels], base: Base,
    sides: Floats | None = None,
) -> Begin:  # fmt: skip
    """Return the best starting point.

    `sides` are g_l and g_r by a heading sensor, divided by the gain, or None.
    """
    kept = _furthest(found, MOST_SPOTS)
    needed = sorted({spot.run for spot in kept})
    grids = {run: grid(driven[run], angles[run], COARSE_S) for run in needed}
    begun: list[Begin] = []
    for left, way in itertools.product((1.0, -1.0), (1.0, -1.0)):
        tried = [_tried(kept, grids, base, (left, way * turn, 0.0)) for turn in TURNS]
        begun += [one for one, *others in _neighbours(tried) if one.unexplained <= min(others)]
    if sides is not None:
        left, way = np.sign(sides[0] * sides[1]), np.sign(sides[1]) * np.abs(sides).mean()
        begun.append(_tried(kept, grids, base, (float(left), float(way), 0.0)))

    def worse(one: Begin) -> float:
        return (one.unexplained + NOTHING) * _doubt(one, sides)

    begun.sort(key=worse)
    few, worst = _furthest(kept, SETTLED_SPOTS), FAR_WORSE * worse(begun[0])
    settled = [
        _settled(_timed(one, few, grids, base), few, grids, base)
        for one in begun[:MOST_BEGUN]
        if worse(one) <= worst
    ]
    return min(settled, key=worse)


def _furthest(found: Sequence[Spots], most: int) -> list[Spots]:
    reach = [float(np.ptp(s.place.real) + np.ptp(s.place.imag)) for s in found]
    kept = [found[i] for i in sorted(np.argsort(reach)[::-1][:most])]
    return [
        replace(s, t=s.t[:: 1 + len(s.t) // MOST_POINTS],
                place=s.place[:: 1 + len(s.t) // MOST_POINTS])
        for s in kept
    ]  # fmt: skip


def _neighbours(tried: Sequence[Begin]) -> list[tuple[Begin, float, float]]:
    """Return each starting point with the unexplained fractions of its neighbours."""
    left = [np.inf, *(one.unexplained for one in tried), np.inf]
    return [(one, left[at], left[at + 2]) for at, one in enumerate(tried)]


def _doubt(begun: Begin, sides: Floats | None) -> float:
    """Return how much less likely this robot is than a usual one, as a factor of at least 1."""
    signed = begun.parameters[[LEFT, RIGHT]] * begun.parameters[TURN]
    turn, (least, most) = float(np.abs(signed).mean()), USUAL_TURN
    like = np.ones(2)
    if sides is not None:
        turn, like = turn / max(1e-9, float(np.abs(sides).mean())), np.sign(sides)
        least, most = NEAR_HEADING
    beyond = max(0.0, np.log(least / turn), np.log(turn / most))
    return (1.0 if np.array_equal(np.sign(signed), like) else WRONG_WAY) * float(1.0 + 2.0 * beyond)


def _turn(parameters: Floats) -> float:
    """Return the turn by the right side, with its sign."""
    return float(parameters[TURN] * parameters[RIGHT])


def _timed(begun: Begin, kept: Sequence[Spots], grids: dict[int, Grid], base: Base) -> Begin:
    """Return the starting point with the delay that suits it best."""
    parameters = begun.parameters
    shape = float(np.sign(parameters[LEFT])), float(parameters[TURN] * parameters[RIGHT])
    tried = [_tried(kept, grids, base, (*shape, late)) for late in DELAYS]
    return min([begun, *tried], key=lambda one: one.unexplained)


def _tried(
    kept: Sequence[Spots], grids: dict[int, Grid], base: Base, shape: tuple[float, float, float]
) -> Begin:
    """Return the starting point for a sign of the left side, a turn and a delay."""
    parameters = base.start()
    parameters[[LEFT, RIGHT, TURN, LATE]] = shape[0], 1.0, shape[1], shape[2]
    paths = {run: place(steps, base, parameters) for run, steps in grids.items()}
    cross = spread = size = 0.0
    for spot in kept:
        path = np.interp(spot.t - shape[2], grids[spot.run].t, paths[spot.run])
        seen, gone = spot.place - spot.place.mean(), path - path.mean()
        # Each path is rotated in the best way; all share one scale.
        cross += abs(complex(np.vdot(gone, seen)))
        size += float(np.sum(np.abs(gone) ** 2))
        spread += float(np.sum(np.abs(seen) ** 2))
    if not size or not spread:
        return Begin(parameters, np.inf)
    scale = cross / size
    parameters[[LEFT, RIGHT]] *= scale
    parameters[TURN] /= scale
    return Begin(parameters, 1.0 - cross**2 / (size * spread))


def _settled(begun: Begin, few: Sequence[Spots], grids: dict[int, Grid], base: Base) -> Begin:
    """Refine a starting point by the fit.

    The fit also finds where on the robot the positions are measured, and outliers count less.
    """
    spots = [replace(spot, block=number) for number, spot in enumerate(few)]

    def evidence(parameters: Floats) -> Evidence:
        return places.evidence(spots, paths(parameters), parameters, len(spots))

    def paths(parameters: Floats) -> dict[int, places.Path]:
        return {run: places.path(steps, base, parameters) for run, steps in grids.items()}

    def unexplained(parameters: Floats) -> float:
        spread = sum(float(np.sum(np.abs(s.place - s.place.mean()) ** 2)) for s in spots)
        off = places.spread(spots, paths(parameters), parameters)
        return off**2 * sum(len(s.t) for s in spots) / spread if spread else np.inf

    before = Begin(begun.parameters, unexplained(begun.parameters))
    if not np.isfinite(before.unexplained):
        return begun
    parameters = fit([evidence], begun.parameters, places=True).parameters
    moved = _turn(parameters) / _turn(begun.parameters)
    if not 1 / STRAYED < moved < STRAYED:
        return before  # the data does not determine the turn there
    after = Begin(parameters, unexplained(parameters))
    return min([before, after], key=lambda one: one.unexplained)
