"""Where to begin with positions alone: Gauss-Newton needs a track that is nearly right.

Tried are tracks from a tenth to thirty times the configured one, turned the right way round and the
wrong, and with one side reversed. How large the path comes out then is the radius.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.evidence import LATE, LEFT, RIGHT, TURN, Base
from acsard.calibration.paths import Wheels
from acsard.calibration.places import Grid, Spots, grid, place
from acsard.calibration.runs import Run
from acsard.calibration.table import Floats

TURNS = np.geomspace(0.03, 10.0, 60)
"""Configured over true track, for wheels of the configured radius."""

DELAYS = np.arange(-1.5, 1.55, 0.1)
"""s."""

MOST_SPOTS = 60
"""Blocks that are looked at, those that reach furthest: it is a search, and no fit yet."""


COARSE_S = 0.1
"""The paths are summed in such steps here."""


class Begin(Struct, frozen=True):
    """What fits best; `unexplained` is the share of the positions' spread that it leaves."""

    parameters: Floats
    unexplained: float


def search(
    found: Sequence[Spots], driven: Sequence[Run], angles: Sequence[Wheels], base: Base
) -> Begin:
    """The best of all that is tried."""
    reach = [float(np.ptp(s.place.real) + np.ptp(s.place.imag)) for s in found]
    kept = [found[i] for i in sorted(np.argsort(reach)[::-1][:MOST_SPOTS])]
    needed = sorted({spot.run for spot in kept})
    grids = {run: grid(driven[run], angles[run], COARSE_S) for run in needed}
    best = Begin(base.start(), np.inf)
    for left, way in itertools.product((1.0, -1.0), (1.0, -1.0)):
        for turn in TURNS:
            best = _better(best, kept, grids, base, (left, way * turn, 0.0))
    begun = best.parameters
    shape = float(np.sign(begun[LEFT])), float(begun[TURN] * begun[RIGHT])
    for late in DELAYS:
        best = _better(best, kept, grids, base, (*shape, late))
    return best


def _better(
    best: Begin, kept: Sequence[Spots], grids: dict[int, Grid], base: Base,
    shape: tuple[float, float, float],
) -> Begin:  # fmt: skip
    """The better of the best so far and this sign of the left side, turn and delay."""
    parameters = base.start()
    parameters[[LEFT, RIGHT, TURN, LATE]] = shape[0], 1.0, shape[1], shape[2]
    paths = {run: place(steps, base, parameters) for run, steps in grids.items()}
    cross = spread = size = 0.0
    for spot in kept:
        path = np.interp(spot.t - shape[2], grids[spot.run].t, paths[spot.run])
        seen, gone = spot.place - spot.place.mean(), path - path.mean()
        # Along the best rotation of each, one scale for all.
        cross += abs(complex(np.vdot(gone, seen)))
        size += float(np.sum(np.abs(gone) ** 2))
        spread += float(np.sum(np.abs(seen) ** 2))
    if not size or not spread:
        return best
    unexplained = 1.0 - cross**2 / (size * spread)
    if unexplained >= best.unexplained:
        return best
    scale = cross / size
    parameters[[LEFT, RIGHT]] *= scale
    parameters[TURN] /= scale
    return Begin(parameters, unexplained)
