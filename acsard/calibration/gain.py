"""The improvement that a calibration brings, measured on drives that were not fitted.

Each run is left out in turn and the parameters found without it are tested on it. If there are
fewer than three runs, fifths of the log are left out instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.evidence import RATE, TURN, Base
from acsard.calibration.fit import TURNING, Fit, Rates
from acsard.calibration.heading import Rows, turned
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import Block
from acsard.calibration.places import Grid, Spots, path, spread

FOLDS = 5
LEAST_RUNS = 3
"""Number of runs from which on whole runs are left out. Below it, fifths of the log are."""

STRAIGHT = 0.1
"""Largest curvature of a straight by the wheels, rad/m, however slowly the robot turns."""

TOLD = 0.1
"""Largest standard deviation, as a fraction, of a block's own track by positions that is used."""


class Error(Struct, frozen=True):
    """An error as configured and as calibrated; None if it cannot be measured."""

    now: float | None
    then: float | None


class Gain(Struct, frozen=True):
    """Errors before and after the calibration.

    The parameters after the calibration are those that were found without the data they are tested
    on.
    """

    turn: Error
    """Heading error after a turn of 360 deg, deg."""
    straight: Error
    """Heading error after 10 m straight on, deg.

    It comes from turns that were neither commanded nor seen by the wheels.
    """
    place: Error
    """Distance of the positions from the path over the length of a block, m rms."""


class Held(Struct, frozen=True):
    """The mask of blocks that were left out, and the parameters found without them."""

    blocks: npt.NDArray[np.bool_]
    parameters: Floats


def folds(fit: Fit, parts: Sequence[Block], rate: Rates) -> Iterator[Held]:
    """Yield groups of blocks to leave out. Each block is in exactly one group."""
    runs = np.array([part.run for part in parts])
    group = runs
    if len(set(runs.tolist())) < LEAST_RUNS:
        group = np.arange(len(parts)) * FOLDS // len(parts)
    for number in sorted(set(group.tolist())):
        out = np.asarray(group == number)
        yield Held(out, constant(fit.without(out), rate))


def constant(parameters: Floats, rate: Rates) -> Floats:
    """Return the parameters with one track for all turn rates, as the robot uses them."""
    fixed = parameters.copy()
    fixed[TURN] *= 1.0 - fixed[RATE] * rate.mean
    fixed[RATE] = 0.0
    return fixed


def gain(
    fit: Fit, base: Base, parts: Sequence[Block], rate: Rates, rows: Rows, truth: Floats,
    spots: Sequence[Spots], grids: Sequence[Grid],
) -> Gain:  # fmt: skip
    """Return the errors before and after the calibration.

    `truth` is the robot's turn in each row as well as it is known, rad.
    """
    held = list(folds(fit, parts, rate))
    now = fit.parameters.copy()
    now[: RATE + 1] = base.start()[: RATE + 1]
    by_wheels = turned(rows, base, now)
    off_now = truth - by_wheels
    off_then = np.zeros_like(truth)
    for one in held:
        mine = one.blocks[rows.block]
        off_then[mine] = (truth - turned(rows, base, one.parameters))[mine]
    turning = np.abs(truth) > TURNING * rows.seconds
    way = base.radius * np.abs(rows.left + rows.right) / 2
    ahead = ~turning & (truth != 0.0) & (np.abs(by_wheels) < STRAIGHT * way)
    side = 2 * rows.block + (truth > 0.0)
    amount, metres = float(np.abs(truth[turning]).sum()), float(way[ahead].sum())
    return Gain(
        _error(off_now, off_then, side, turning, 360.0, amount),
        _error(off_now, off_then, rows.block, ahead, np.degrees(10.0), metres),
        _place(held, now, base, spots, grids),
    )


def _error(
    now: Floats, then: Floats, group: npt.NDArray[np.int64], among: npt.NDArray[np.bool_],
    unit: float, amount: float,
) -> Error:  # fmt: skip
    """Return the sums of absolute group errors, per unit of `amount`, before and after."""
    if amount <= 0.0:
        return Error(None, None)
    sizes = [np.abs(np.bincount(group[among], off[among])).sum() for off in (now, then)]
    return Error(*(float(unit * size / amount) for size in sizes))


def _place(
    held: Sequence[Held], now: Floats, base: Base, spots: Sequence[Spots], grids: Sequence[Grid]
) -> Error:
    if not spots:
        return Error(None, None)
    then = []
    for one in held:
        mine = [spot for spot in spots if one.blocks[spot.block]]
        paths = [path(grid, base, one.parameters) for grid in grids]
        then.append((spread(mine, paths, one.parameters), sum(len(spot.t) for spot in mine)))
    squares = sum(size**2 * count for size, count in then)
    off = float(np.sqrt(squares / max(1, sum(count for _, count in then))))
    return Error(spread(spots, [path(grid, base, now) for grid in grids], now), off)


def seen_by_places(fit: Fit, rows: Rows, base: Base) -> Floats:
    """Return the robot's turn in each row, rad, as the positions alone show it.

    Each block uses the track that suits it best. The turn is 0 in a block whose track is too
    uncertain.
    """
    size = np.maximum(fit.normal[:, TURN, TURN], 1e-300)
    own = 1.0 + fit.score[:, TURN] / size / fit.parameters[TURN]
    own[1 / np.sqrt(size) > TOLD * abs(fit.parameters[TURN])] = 0.0
    return np.asarray(turned(rows, base, fit.parameters) * own[rows.block])
