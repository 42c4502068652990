"""Compares turns of the robot, computed from the wheels, with those of a heading sensor.

The sensor is a gyro, or the yaw of a position source. The equation is that of Antonelli, Chiaverini
& Fusco (A calibration method for odometry of mobile robots, 2005): turn = g_r phi_r - g_l phi_l,
with the angles phi by which the wheels rolled, and g = wheel radius / effective track.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.fit import (
    PARAMETER_COUNT,
    Base,
    Evidence,
    Parameter,
    evidence_from_measurements,
    huber,
)
from acsard.calibration.log_table import Floats, LogError
from acsard.calibration.runs import Block, Run, gaps, inside, integral, rest_intervals
from acsard.core.values import RadPerS, Seconds

# A standstill that shows the gyro's bias lasts `REST_S` after `EDGE_S`, in which the robot may
# shake, is cut off at both ends.
REST_S, EDGE_S = 0.6, 0.3

# Above this difference from the usual rate, rad/s, a person turned the robot in a standstill.
MAX_RATE_AT_REST = 0.05

MIN_SAMPLES = 5  # minimum number of gyro samples in a standstill from which the bias is measured

OUTLIER_RATIO = 6.0  # median deviations of an outlier from the median of a standstill

# Of the gyro bias, rad/s per square root of a second: the smallest, and the usual one if no run has
# two standstills that could be compared.
MIN_RANDOM_WALK = 5e-5
ASSUMED_RANDOM_WALK = 2e-4

INTERVAL_S = 1.0  # approximate length of the intervals of a comparison

# Step of the search for the heading sensor's delay, and the largest delay that is tried.
GRID_S, FURTHEST_S = 0.02, 2.0

DEGREES_RATIO = 10.0  # of the turns of yaw and wheels, above which the yaw is in degrees


class Heading(Struct, frozen=True):
    """The heading of a run as a sensor measured it."""

    t: Floats  # times of the sensor's samples, s
    angle: Floats  # heading at the times `t`, rad, without jumps by 2 pi
    gaps: Floats  # long intervals without a sample, s: one row (begin, end) for each


class Headings(Struct, frozen=True):
    """The headings of all runs, measured by one sensor, and the sensor's delay and bias."""

    source: str  # column of the log from which the headings come: "yaw_rate" or "yaw"
    per_run: tuple[Heading, ...]
    delay: Seconds  # of the sensor's recorded times after those of the wheels
    bias: RadPerS  # median of the gyro biases in standstills
    bias_unknown: bool  # no standstill shows the gyro's bias, so that the wheels must show it
    bias_std: RadPerS = 0.0


STRAIGHT_RATE = 0.05  # turn rate up to which the robot is considered to drive straight, rad/s

FASTEST_QUANTILE = 0.95  # of the turned angle at rates below `Rates.fastest`


class Rows(Struct, frozen=True):
    """The motion of the robot in intervals of about a second."""

    block: npt.NDArray[np.int64]  # index of the block of each interval
    turned: Floats  # by the heading sensor, rad; 0 if there is none
    left: Floats  # rolled by the left wheels, rad
    right: Floats
    # Integral of |w| w, rad2/s, with w right minus left wheel speed: `TRACK_GROWTH` scales it.
    signed_square_integral: Floats
    seconds: Floats


class Rates(Struct, frozen=True):
    """Statistics of the turn rates in a log."""

    mean: RadPerS  # weighted by the turned angle
    fastest: RadPerS  # below which the robot turned `FASTEST_QUANTILE` of its total angle


def of_gyro(driven: Sequence[Run]) -> Headings | None:
    """Return the headings integrated from the column yaw_rate, or None if no run has this column.

    Raises `LogError` if the turn rate never changes.
    """
    if not any(len(run.gyro) for run in driven):
        return None
    if all(np.ptp(run.gyro) == 0.0 for run in driven if len(run.gyro)):
        raise LogError(
            "column yaw_rate has the same value in every row: the gyro was not recorded, or is dead"
        )
    biases = [_biases(run) for run in driven]
    all_biases = np.concatenate([values for _, values, _ in biases])
    usual = float(np.median(all_biases)) if len(all_biases) else 0.0
    yaws, rested = [], []
    for run, (t, values, noise) in zip(driven, biases, strict=True):
        true = np.abs(values - usual) < MAX_RATE_AT_REST
        rested.append((t[true], values[true], noise[true]))
        bias = np.interp(run.gyro_t, t[true], values[true]) if true.any() else usual
        rate = run.gyro - bias
        holes = gaps(run.gyro_t)
        steps = np.diff(run.gyro_t)
        steps[np.isin(run.gyro_t[:-1], holes[:, 0])] = 0.0
        yaws.append(Heading(run.gyro_t, integral(rate, steps), holes))
    seconds = [float(run.t[-1]) for run in driven]
    return Headings(
        "yaw_rate", tuple(yaws), offset(yaws, driven), usual, bias_unknown=not len(all_biases),
        bias_std=_bias_std(rested, seconds) if len(all_biases) else 0.0,
    )  # fmt: skip


def of_yaw(driven: Sequence[Run], radius_per_separation: float) -> Headings | None:
    """Return the headings in the column yaw, or None if no run has this column.

    Raises `LogError` if the yaw is in degrees.
    """
    if not any(len(run.yaw) for run in driven):
        return None
    yaws = []
    for run in driven:
        if _in_degrees(run, radius_per_separation):
            raise LogError(
                "column yaw is in degrees, but must be in radians: multiply its values by pi / 180"
            )
        angle = np.asarray(np.unwrap(run.yaw)) if len(run.yaw) else run.yaw
        yaws.append(Heading(run.yaw_t, angle, gaps(run.yaw_t)))
    return Headings("yaw", tuple(yaws), offset(yaws, driven), 0.0, bias_unknown=False)


def _in_degrees(run: Run, radius_per_separation: float) -> bool:
    if len(run.yaw) < 2 or np.ptp(run.yaw) < 3 * np.pi:
        return False
    steps = np.diff(run.yaw)
    if np.any((np.abs(steps) > 300.0) & (np.abs(steps) < 400.0)):
        return True
    left, right = run.angles(run.yaw_t)
    by_wheels = radius_per_separation * np.diff(right - left)
    small = np.abs(steps) < 100.0
    return float(np.sum(np.abs(steps[small]))) > DEGREES_RATIO * float(
        np.sum(np.abs(by_wheels[small]))
    )


Rests = tuple[Floats, Floats, Floats]  # standstills: times, s, biases, rad/s, variances, rad2/s2


def _biases(run: Run) -> Rests:
    means = []
    for begin, end in rest_intervals(run, REST_S, EDGE_S):
        a, b = np.searchsorted(run.gyro_t, (begin, end))
        if b - a >= MIN_SAMPLES:
            means.append(((begin + end) / 2, *_mean(run.gyro[a:b])))
    times, values, noise = np.array(means, dtype=np.float64).reshape(-1, 3).T
    return times, values, noise


def _mean(samples: Floats) -> tuple[float, float]:
    off = np.abs(samples - np.median(samples))
    steps = np.diff(np.unique(samples))
    step = float(steps.min()) if len(steps) else 0.0
    inliers = samples[off <= max(OUTLIER_RATIO * float(np.median(off)), 1.01 * step)]
    inliers = inliers if len(inliers) >= MIN_SAMPLES else samples
    # The variance of five means is right for correlated noise too. The median of a coarse gyro is
    # always one of its few values.
    parts = [float(part.mean()) for part in np.array_split(inliers, MIN_SAMPLES)]
    few = step**2 / 12 if len(np.unique(inliers)) <= 2 else 0.0
    return float(inliers.mean()), float(np.var(parts, ddof=1)) / len(parts) + few


def _bias_std(rested: Sequence[Rests], seconds: Sequence[float]) -> float:
    count = sum(len(t) for t, _, _ in rested)
    noise = sum(float(variance.sum()) for _, _, variance in rested) / max(1, count) ** 2
    walked = [np.column_stack((np.diff(v) ** 2 - n[1:] - n[:-1], np.diff(t))) for t, v, n in rested]
    changed, lasted = np.concatenate(walked).sum(axis=0)
    # An estimate from few differences is uncertain.
    few = 1 + 2 / max(1, count - len(rested))
    walk = max(MIN_RANDOM_WALK**2, few * changed / lasted) if lasted else ASSUMED_RANDOM_WALK**2
    # Between two standstills, the bias error is a Brownian bridge, otherwise a free random walk.
    whole = sum(seconds)
    between = sum(float(np.sum(np.diff(t) ** 3)) for t, _, _ in rested) / 12
    outside = sum(
        (t[0] ** 3 + (last - t[-1]) ** 3) / 3 if len(t) else last**3 / 3
        for (t, _, _), last in zip(rested, seconds, strict=True)
    )
    return float(np.sqrt(noise + walk * (between + outside) / whole**2))


def offset(headings: Sequence[Heading], driven: Sequence[Run]) -> float:
    """Return the delay of a heading sensor's recorded times relative to those of the wheels, s.

    It is the delay, up to `FURTHEST_S`, for which the turns correlate best; 0 if there are no
    turns.
    """
    reach = round(FURTHEST_S / GRID_S)
    scores, sizes = np.zeros((2, 2 * reach + 1)), np.zeros(2)
    for heading, run in zip(headings, driven, strict=True):
        grid = np.arange(run.t[0], run.t[-1], GRID_S)
        if len(heading.t) < 2 or len(grid) < 4:
            continue
        left, right = run.angles(grid)
        sensor = np.diff(np.interp(grid, heading.t, heading.angle))
        sensor[~inside(grid[:-1], grid[1:], heading.gaps)] = 0.0
        sensor -= sensor.mean()
        # Also try the sum of the angles: the speeds of one side may have the wrong sign.
        for at, series in enumerate((np.diff(right - left), np.diff(right + left))):
            centred = series - series.mean()
            scores[at] += _correlation(sensor, centred, reach)
            sizes[at] += float(centred @ centred)
    alike = np.abs(scores) / np.sqrt(np.maximum(sizes, 1e-300))[:, None]
    score = alike[int(np.argmax(alike.max(axis=1)))]
    best = int(np.argmax(score))
    if not 0 < best < 2 * reach:
        return 0.0 if not score.any() else float(best - reach) * GRID_S
    before, top, after = score[best - 1 : best + 2]
    bend = before - 2 * top + after
    return float(best - reach + (0.5 * (before - after) / bend if bend else 0.0)) * GRID_S


def _correlation(later: Floats, earlier: Floats, reach: int) -> Floats:
    size = 1 << (len(later) + reach).bit_length()
    spectrum = np.fft.rfft(later, size) * np.conj(np.fft.rfft(earlier, size))
    whole = np.fft.irfft(spectrum, size)
    return np.concatenate((whole[-reach:], whole[: reach + 1]))


def rows(headings: Headings | None, driven: Sequence[Run], parts: Sequence[Block]) -> Rows:
    """Return the motion in intervals of about `INTERVAL_S` that the heading sensor covers."""
    squares = [_signed_square_integral(run) for run in driven]
    pieces: list[tuple[Floats, ...]] = []
    for number, part in enumerate(parts):
        count = max(1, round((part.end - part.begin) / INTERVAL_S))
        edges = np.linspace(part.begin, part.end, count + 1)
        angle, whole = np.zeros(count + 1), np.ones(count, dtype=bool)
        if headings is not None:
            heading, sensor_t = headings.per_run[part.run], edges + headings.delay
            if not len(heading.t):
                continue
            angle = np.interp(sensor_t, heading.t, heading.angle)
            whole = inside(sensor_t[:-1], sensor_t[1:], heading.gaps)
            whole &= (sensor_t[:-1] >= heading.t[0]) & (sensor_t[1:] <= heading.t[-1])
        left, right = driven[part.run].angles(edges)
        square_sums = np.interp(edges, driven[part.run].t, squares[part.run])
        series = (angle, left, right, square_sums, edges)
        pieces.append((np.full(count, number)[whole], *(np.diff(sums)[whole] for sums in series)))
    if not pieces:
        return Rows(np.zeros(0, dtype=np.int64), *[np.zeros(0)] * 5)
    block, *columns = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return Rows(block.astype(np.int64), *columns)


def rates(rows: Rows, by_wheels: Floats) -> Rates:
    """Return statistics of the turn rates in a log. They are 0 if the robot hardly turns."""
    turned = np.abs(by_wheels)
    rate = turned / rows.seconds
    turning = rate > STRAIGHT_RATE
    if not turning.any():
        return Rates(0.0, 0.0)
    order = np.argsort(rate[turning])
    share = np.cumsum(turned[turning][order]) / turned[turning].sum()
    fastest = rate[turning][order][int(np.searchsorted(share, FASTEST_QUANTILE))]
    mean = float(rate[turning] @ turned[turning] / turned[turning].sum())
    return Rates(mean, float(fastest))


def without_constant_rate(rows: Rows) -> Rows:
    """Subtract from each column of `rows` its constant rate, fitted by least squares.

    An unknown gyro bias then has no effect on a comparison with the wheels.
    """
    share = rows.seconds / float(rows.seconds @ rows.seconds)
    turned, left, right, squares = (
        column - rows.seconds * float(share @ column)
        for column in (rows.turned, rows.left, rows.right, rows.signed_square_integral)
    )
    return Rows(rows.block, turned, left, right, squares, rows.seconds)


def _signed_square_integral(run: Run) -> Floats:
    apart = run.speed_difference(run.t)
    steps = np.minimum(np.diff(run.t), INTERVAL_S)
    return integral(np.abs(apart) * apart, steps)


# Usual difference of the turns of sensor and wheels: rad per second, and fraction, squares added.
NOISE, SHARE = 0.01, 0.03


def turned(rows: Rows, base: Base, parameters: Floats) -> Floats:
    """Return the robot's turn in each interval, rad, computed from the wheels with `parameters`."""
    left, right, inverse, growth = parameters[: Parameter.DELAY]
    constant = base.radius_per_separation * inverse * (right * rows.right - left * rows.left)
    return np.asarray(constant + growth * _by_growth(rows, base, parameters))


def _by_growth(rows: Rows, base: Base, parameters: Floats) -> Floats:
    left, right, inverse = parameters[: Parameter.TRACK_GROWTH]
    gain = base.radius_per_separation * inverse * (left + right) / 2
    return np.asarray(-gain * abs(gain) * rows.signed_square_integral)


def evidence(rows: Rows, base: Base, parameters: Floats, blocks: int) -> Evidence:
    """Return the evidence of a heading sensor, linearized at `parameters`."""
    turn = parameters[Parameter.INVERSE_TRACK]
    by_wheels = turned(rows, base, parameters)
    jacobian = np.zeros((len(rows.turned), PARAMETER_COUNT))
    jacobian[:, Parameter.LEFT] = -base.radius_per_separation * turn * rows.left
    jacobian[:, Parameter.RIGHT] = base.radius_per_separation * turn * rows.right
    jacobian[:, Parameter.TRACK_GROWTH] = _by_growth(rows, base, parameters)
    jacobian[:, Parameter.INVERSE_TRACK] = (
        by_wheels + jacobian[:, Parameter.TRACK_GROWTH] * parameters[Parameter.TRACK_GROWTH]
    ) / turn
    jacobian[:, Parameter.BIAS_ERROR] = rows.seconds
    jacobian[:, Parameter.SCALE_ERROR] = by_wheels
    gyro = (
        by_wheels * (1 + parameters[Parameter.SCALE_ERROR])
        + parameters[Parameter.BIAS_ERROR] * rows.seconds
    )
    residual = rows.turned - gyro
    return evidence_from_measurements(
        jacobian, residual, _weight(rows, residual, by_wheels), rows.block, blocks
    )


def _weight(rows: Rows, residual: Floats, by_wheels: Floats) -> Floats:
    return huber(residual / np.hypot(NOISE * rows.seconds, SHARE * by_wheels), 1.0)


def bias(rows: Rows, by_wheels: Floats) -> float:
    """Return the gyro's mean difference from the turn rate of the wheels, rad/s."""
    seconds, estimate = rows.seconds, 0.0
    off = rows.turned - by_wheels
    for _ in range(10):
        weight = _weight(rows, off - estimate * seconds, by_wheels)
        estimate = float((weight * seconds) @ off / ((weight * seconds) @ seconds))
    return estimate


def side_factors(rows: Rows, base: Base, *, in_place: bool = False) -> Floats:
    """Return the factors of left and right wheels with which their turns fit the sensor best.

    A factor is wheel radius / effective track, divided by the configured radius / separation. It is
    negative if a sign is wrong. Both are equal if the robot only turns in place (`in_place`).
    """
    columns = base.radius_per_separation * np.column_stack((-rows.left, rows.right))
    if in_place:
        columns = columns.sum(axis=1, keepdims=True)
    weight = np.ones(len(rows.turned))
    sides: Floats = np.zeros(columns.shape[1])
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        sides = np.asarray(np.linalg.lstsq(columns * root, rows.turned * root[:, 0], rcond=None)[0])
        by_wheels = columns @ sides
        weight = _weight(rows, rows.turned - by_wheels, by_wheels)
    return np.resize(sides, 2)


def by_sides(rows: Rows, base: Base, sides: Floats) -> Floats:
    """Return the robot's turn in each interval, rad, with the factors of `side_factors()`."""
    return np.asarray(base.radius_per_separation * (sides[1] * rows.right - sides[0] * rows.left))
