"""The improvement that a calibration brings, by cross-validation.

Each run is left out in turn, and the parameters that were found without it are tested on it. If the
log has fewer than three runs, fifths of the log are left out instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.evidence import INVERSE_TRACK, TRACK_GROWTH, Base
from acsard.calibration.fit import TURNING, Fit, Rates
from acsard.calibration.heading import Rows, turned
from acsard.calibration.log_table import Floats
from acsard.calibration.positions import Segment, WheelSteps, path, spread
from acsard.calibration.wheel_angles import Block

FOLDS = 5
LEAST_RUNS = 3
"""Number of runs from which on whole runs are left out. Below it, fifths of the log are."""

STRAIGHT = 0.1
"""Largest curvature of a straight drive by the wheels, rad/m."""

PRECISE = 0.1
"""Largest standard deviation of the track of one block that is used, as a fraction.

The track of one block is that which suits the positions of this block best.
"""


class BeforeAfter(Struct, frozen=True):
    """An error with the configured and with the new multipliers; None if nothing measures it."""

    before: float | None
    after: float | None


class Improvement(Struct, frozen=True):
    """Odometry errors before and after the calibration.

    The error after the calibration is measured on data that the fit did not use.
    """

    turn: BeforeAfter
    """Heading error after a turn of 360 deg, deg."""
    straight: BeforeAfter
    """Heading error after 10 m straight ahead, deg.

    It comes from turns that the wheels do not show.
    """
    place: BeforeAfter
    """RMS distance of the positions from the path of the wheels within a block, m."""


class Fold(Struct, frozen=True):
    """A mask of blocks that are left out, and the parameters that the other blocks give."""

    blocks: npt.NDArray[np.bool_]
    parameters: Floats


def folds(fit: Fit, parts: Sequence[Block], rate: Rates) -> Iterator[Fold]:
    """Yield the folds of the cross-validation. Each block is left out in exactly one of them."""
    runs = np.array([part.run for part in parts])
    group = runs
    if len(set(runs.tolist())) < LEAST_RUNS:
        group = np.arange(len(parts)) * FOLDS // len(parts)
    for number in sorted(set(group.tolist())):
        out = np.asarray(group == number)
        yield Fold(out, with_constant_track(fit.without(out), rate))


def with_constant_track(parameters: Floats, rate: Rates) -> Floats:
    """Return the parameters with the track of the mean turn rate for all turn rates.

    The odometry of the daemon has one track for all turn rates, unlike the fit.
    """
    fixed = parameters.copy()
    fixed[INVERSE_TRACK] *= 1.0 - fixed[TRACK_GROWTH] * rate.mean
    fixed[TRACK_GROWTH] = 0.0
    return fixed


def improvement(
    fit: Fit, base: Base, parts: Sequence[Block], rate: Rates, rows: Rows, truth: Floats,
    segments: Sequence[Segment], steps: Sequence[WheelSteps],
) -> Improvement:  # fmt: skip
    """Return the errors before and after the calibration.

    Args:
        fit: the fit to the whole log.
        base: the configured geometry.
        parts: the blocks of the log.
        rate: the turn rates of the log.
        rows: the turns of the log.
        truth: the robot's turn in each row, rad, as the sensors show it; 0 if they do not.
        segments: the positions of the log.
        steps: the wheel steps of each run.
    """
    held = list(folds(fit, parts, rate))
    configured = fit.parameters.copy()
    configured[: TRACK_GROWTH + 1] = base.start()[: TRACK_GROWTH + 1]
    by_wheels = turned(rows, base, configured)
    before = truth - by_wheels
    after = np.zeros_like(truth)
    for fold in held:
        out = fold.blocks[rows.block]
        after[out] = (truth - turned(rows, base, fold.parameters))[out]
    turning = np.abs(truth) > TURNING * rows.seconds
    distance = base.radius * np.abs(rows.left + rows.right) / 2
    straight = ~turning & (truth != 0.0) & (np.abs(by_wheels) < STRAIGHT * distance)
    block_and_side = 2 * rows.block + (truth > 0.0)
    angle, metres = float(np.abs(truth[turning]).sum()), float(distance[straight].sum())
    return Improvement(
        _per_amount(before, after, block_and_side, turning, 360.0, angle),
        _per_amount(before, after, rows.block, straight, np.degrees(10.0), metres),
        _of_positions(held, configured, base, segments, steps),
    )


def _per_amount(
    before: Floats, after: Floats, group: npt.NDArray[np.int64], among: npt.NDArray[np.bool_],
    unit: float, amount: float,
) -> BeforeAfter:  # fmt: skip
    """Return the sums of the absolute errors of the groups, times `unit / amount`."""
    if amount <= 0.0:
        return BeforeAfter(None, None)
    sums = [np.abs(np.bincount(group[among], errors[among])).sum() for errors in (before, after)]
    return BeforeAfter(*(float(unit * total / amount) for total in sums))


def _of_positions(
    held: Sequence[Fold], configured: Floats, base: Base, segments: Sequence[Segment],
    steps: Sequence[WheelSteps],
) -> BeforeAfter:  # fmt: skip
    if not segments:
        return BeforeAfter(None, None)
    squares, count = 0.0, 0
    for fold in held:
        out = [segment for segment in segments if fold.blocks[segment.block]]
        paths = [path(run, base, fold.parameters) for run in steps]
        points = sum(len(segment.t) for segment in out)
        squares, count = squares + spread(out, paths, fold.parameters) ** 2 * points, count + points
    before = spread(segments, [path(run, base, configured) for run in steps], configured)
    return BeforeAfter(before, float(np.sqrt(squares / max(1, count))))


def turns_by_positions(fit: Fit, rows: Rows, base: Base) -> Floats:
    """Return the robot's turn in each row, rad, as the positions alone show it.

    The turn is that of the wheels with the track that suits the positions of its block best. It is
    0 if this track is too uncertain.
    """
    size = np.maximum(fit.normal[:, INVERSE_TRACK, INVERSE_TRACK], 1e-300)
    ratio = 1.0 + fit.score[:, INVERSE_TRACK] / size / fit.parameters[INVERSE_TRACK]
    ratio[1 / np.sqrt(size) > PRECISE * abs(fit.parameters[INVERSE_TRACK])] = 0.0
    return np.asarray(turned(rows, base, fit.parameters) * ratio[rows.block])
