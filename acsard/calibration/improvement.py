"""Measures the improvement that a calibration brings, on drives that the fit did not use.

Each run is left out in turn, or each fifth of a log with fewer than three runs. The parameters are
fitted to the rest, and the odometry error is measured on the part that was left out. New values
replace the configured ones only if they are better by more than chance explains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.fit import Base, Fit, Parameter, student_factor
from acsard.calibration.heading import STRAIGHT_RATE, Rates, Rows, turned
from acsard.calibration.log_table import Floats
from acsard.calibration.positions import Segment, WheelSteps, path, segments, spread
from acsard.calibration.runs import Block, Mask, Run, cumulative

FOLDS = 5
MIN_RUNS = 3  # with fewer, a fifth of the log is left out at a time

MAX_STRAIGHT_CURVATURE = 0.1  # rad/m by the wheels, below which the path counts as straight

MIN_STRAIGHT_M = 1.0  # with less, the heading error per 10 m would be only noise


class BeforeAfter(Struct, frozen=True):
    """An odometry error with the configured and with the new multipliers; None if it is unknown."""

    before: float | None
    after: float | None


NOT_COMPARED = BeforeAfter(None, None)

SURE_DEVIATIONS = 2.0  # ratio of a gain to its standard deviation at which it is sure (95 %)

# Half of an error. A larger gain is sure: in a guided drive, one leg may show nearly all of it.
SURE_GAIN = float(np.log(2.0))

# Nearer than `NEAR` deviations, the configured multipliers stay. Beyond `FAR` (one log of thirty by
# chance), a smaller gain is enough: half of it at twice `FAR`.
NEAR, FAR = 2.0, 3.0

MIN_SQUARE = 1e-9  # m2 or deg2, added because 0 does not have a logarithm


class Improvement(Struct, frozen=True):
    """Odometry errors before and after the calibration, on data that the fit did not use."""

    turn: BeforeAfter  # heading error after a turn of 360 deg, deg
    straight: BeforeAfter  # heading error after 10 m straight ahead, deg
    heading: BeforeAfter  # RMS over whole drives, deg
    place: BeforeAfter  # RMS over whole drives, m
    log_improvement: float = np.inf  # a sum of logarithms; inf if it was not computed
    gain_std: float = 0.0  # of `log_improvement`, from the differences between drives
    apart: float = FAR  # new multipliers from the configured ones, in standard deviations

    @property
    def sure(self) -> bool:
        """Whether the new multipliers are better by more than chance explains."""
        least = SURE_DEVIATIONS * self.gain_std * min(1.0, FAR / max(NEAR, self.apart))
        return self.apart > NEAR and self.log_improvement > min(least, SURE_GAIN)


UNMEASURED = Improvement(NOT_COMPARED, NOT_COMPARED, NOT_COMPARED, NOT_COMPARED)


class Fold(Struct, frozen=True):
    """One step of the cross-validation: a drive, and parameters fitted without this drive."""

    drive: Block
    blocks: Mask  # that the fit leaves out, because they overlap the drive
    parameters: Floats


def drives(driven: Sequence[Run]) -> list[Block]:
    """Return the parts of the log that the cross-validation leaves out, one at a time."""
    longest = np.inf
    if len(driven) < MIN_RUNS:
        longest = sum(float(run.t[-1]) for run in driven) / FOLDS
    parts = []
    for number, run in enumerate(driven):
        edges = np.linspace(0.0, run.t[-1], max(1, round(float(run.t[-1]) / longest)) + 1)
        parts += [Block(number, float(a), float(b)) for a, b in pairwise(edges)]
    return parts


def positions_of(drive: Block, driven: Sequence[Run]) -> list[Segment]:
    """Return the measured positions in a drive, split into segments.

    A new segment begins at each jump of the positions, and at each gap in the wheel samples.
    """
    gaps = driven[drive.run].gaps
    edges = np.concatenate(([drive.begin], gaps.ravel(), [drive.end])).clip(drive.begin, drive.end)
    pieces = [Block(drive.run, float(a), float(b)) for a, b in edges.reshape(-1, 2)]
    return segments(driven, [piece for piece in pieces if piece.end > piece.begin])


def folds(fit: Fit, parts: Sequence[Block], driven: Sequence[Run], rate: Rates) -> list[Fold]:
    """Return a fold for each of `drives(driven)`, with the parameters that fit all other drives.

    A drive has no fold if no block overlaps it, or if all blocks do.
    """
    run, begin, end = (
        np.array(column) for column in zip(*((p.run, p.begin, p.end) for p in parts), strict=True)
    )
    result = []
    for drive in drives(driven):
        out = (run == drive.run) & (begin < drive.end - 1e-6) & (end > drive.begin + 1e-6)
        if out.any() and not out.all():
            result.append(Fold(drive, out, with_constant_track(fit.without(out), rate)))
    return result


def with_constant_track(parameters: Floats, rate: Rates) -> Floats:
    """Return the parameters with the track at the log's mean turn rate, as the daemon uses it."""
    fixed = parameters.copy()
    fixed[Parameter.INVERSE_TRACK] *= 1.0 - fixed[Parameter.TRACK_GROWTH] * rate.mean
    fixed[Parameter.TRACK_GROWTH] = 0.0
    return fixed


def improvement(
    test_folds: Sequence[Fold], configured: Floats, base: Base, rows: Rows,
    places: Sequence[Sequence[Segment]], steps: Sequence[WheelSteps],
) -> Improvement:  # fmt: skip
    """Return the errors of the odometry before and after, on drives that the fit did not use.

    `configured` are the parameters with the configured multipliers. `places` has the positions of
    each fold's drive. `steps` is empty if the log has no positions.
    """
    by_wheels = turned(rows, base, configured)
    before = rows.turned - by_wheels
    after = before.copy()
    for fold in test_folds:
        out = fold.blocks[rows.block]
        after[out] = (rows.turned - turned(rows, base, fold.parameters))[out]
    measured = rows.turned != 0.0
    turning = np.abs(rows.turned) > STRAIGHT_RATE * rows.seconds
    distance = base.radius * np.abs(rows.left + rows.right) / 2
    straight = ~turning & measured & (np.abs(by_wheels) < MAX_STRAIGHT_CURVATURE * distance)
    block_and_side = 2 * rows.block + (rows.turned > 0.0)
    angle, metres = float(np.abs(rows.turned[turning]).sum()), float(distance[straight].sum())
    if metres < MIN_STRAIGHT_M:
        metres = 0.0
    squares = [_of_headings(test_folds, before, after, rows)] if measured.any() else []
    squares += [_of_positions(test_folds, configured, base, places, steps)] if steps else []
    gain, gain_std = _gain(squares)
    of_heading, of_place = (
        rms(squares[0].sum(axis=0)) if measured.any() else NOT_COMPARED,
        rms(squares[-1].sum(axis=0)) if steps else NOT_COMPARED,
    )
    return Improvement(
        per_amount(_by_group(before, after, block_and_side, turning, angle), 360.0),
        per_amount(_by_group(before, after, rows.block, straight, metres), np.degrees(10.0)),
        of_heading, of_place, gain, gain_std,
    )  # fmt: skip


def rms(sums: Floats) -> BeforeAfter:
    """Return RMS errors from the two sums of squared errors and the number of samples."""
    before, after, count = sums.tolist()
    if not count:
        return NOT_COMPARED
    return BeforeAfter(float(np.sqrt(before / count)), float(np.sqrt(after / count)))


def per_amount(sums: Floats, unit: float) -> BeforeAfter:
    """Return errors per driven angle or distance, in `unit`, from two sums and the amount."""
    before, after, amount = sums.tolist()
    if not amount:
        return NOT_COMPARED
    return BeforeAfter(float(unit * before / amount), float(unit * after / amount))


def _gain(kinds: Sequence[Floats]) -> tuple[float, float]:
    drives = np.any([squares[:, 2] > 0.0 for squares in kinds], axis=0)
    if not np.any(drives):
        return 0.0, np.inf

    def gain(left: Mask) -> float:
        sums = [squares[left].sum(axis=0) + MIN_SQUARE for squares in kinds]
        return float(sum(np.log(before / after) for before, after, _ in sums) / 2)

    return with_gain_std(gain, drives)


def with_gain_std(gain: Callable[[Mask], float], drives: Mask) -> tuple[float, float]:
    """Return the gain from all drives in the mask, and its standard deviation by a jackknife.

    The deviation is infinite for a single drive.
    """
    count = int(drives.sum())
    if count == 1:
        return gain(drives), np.inf
    alone = [gain(drives & (np.arange(len(drives)) != at)) for at in np.flatnonzero(drives)]
    gain_std = float(np.sqrt((count - 1) * student_factor(count - 1.0)) * np.std(alone))
    return gain(drives), gain_std


def _by_group(
    before: Floats, after: Floats, group: npt.NDArray[np.int64], among: Mask, amount: float
) -> Floats:
    sums = (np.abs(np.bincount(group[among], errors[among])).sum() for errors in (before, after))
    return np.array([*sums, amount])


def _of_headings(test_folds: Sequence[Fold], before: Floats, after: Floats, rows: Rows) -> Floats:
    squares = np.zeros((len(test_folds), 3))
    for number, fold in enumerate(test_folds):
        out = fold.blocks[rows.block]
        for index, errors in enumerate((before[out], after[out])):
            heading = np.degrees(cumulative(errors))
            squares[number, index] = float(np.sum((heading - heading.mean()) ** 2))
        squares[number, 2] = len(heading) if out.any() else 0
    return squares


def _of_positions(
    test_folds: Sequence[Fold], configured: Floats, base: Base,
    places: Sequence[Sequence[Segment]], steps: Sequence[WheelSteps],
) -> Floats:  # fmt: skip
    squares = np.zeros((len(test_folds), 3))
    present = [path(run, base, configured) for run in steps]
    for number, (fold, out) in enumerate(zip(test_folds, places, strict=True)):
        if points := sum(len(segment.t) for segment in out):
            run = fold.drive.run
            new = {run: path(steps[run], base, fold.parameters)}
            errors = spread(out, present), spread(out, new)
            squares[number] = [*(points * error**2 for error in errors), points]
    return squares


def no_better(result: Improvement) -> str:
    """Return the text of the error for new multipliers that are not clearly better."""
    errors = ", ".join(
        f"{name} {error.before * factor:.2g} {unit} now and {error.after * factor:.2g} {unit} "
        "with the new values"
        for name, error, unit, factor in (
            ("heading", result.heading, "deg", 1.0), ("position", result.place, "cm", 100.0)
        )
        if error.before is not None and error.after is not None
    )  # fmt: skip
    compared = (
        f"the errors on drives that the fit did not use are: {errors}"
        if errors
        else "the errors could not be compared, because no drive of the log could be left out of "
        "the fit"
    )
    return (
        "the multipliers that were computed from this log are not clearly better than the "
        f"configured ones: keep the configured multipliers; {compared}"
    )
