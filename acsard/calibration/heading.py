"""Turns of the robot as a gyro, or the yaw of a position source, shows them, and their evidence.

The rows follow Antonelli, Chiaverini & Fusco (A calibration method for odometry of mobile robots
based on the least-squares technique, 2005): turned = g_r dphi_r - g_l dphi_l, linear in g_r = R_r /
L and g_l = R_l / L.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.evidence import (
    COUNT,
    DRIFT,
    LEFT,
    RATE,
    RIGHT,
    STRETCH,
    TURN,
    Base,
    Evidence,
    huber,
    of_rows,
)  # fmt: skip
from acsard.calibration.log_table import Floats, LogError
from acsard.calibration.paths import Block, Wheels, cumulative, gaps, inside, rests
from acsard.calibration.runs import Run

REST_S, EDGE_S = 0.6, 0.3
"""Shortest rest in which the gyro bias is measured, and the margin cut off at both of its ends, s.

The robot still shakes within the margin.
"""

TURNED_BY_HAND = 0.05
"""Deviation from the usual bias, rad/s, above which a resting robot is being turned by hand."""

LEAST_SAMPLES, OUTLIER = 5, 6.0
"""Smallest number of gyro samples in a rest.

`OUTLIER` is the multiple of the median deviation above which a sample is not noise.
"""

WALK, UNSEEN_WALK = 5e-5, 2e-4
"""Random walk of a gyro bias, rad/s per square root of a second.

`WALK` is the smallest that is assumed, for a usual MEMS gyro. `UNSEEN_WALK` is assumed if there is
only a single rest, which shows no walk.
"""

ROW_S = 1.0
"""Approximate time over which turns are compared, s."""

GRID_S, FURTHEST_S = 0.02, 2.0
"""Step and range of the search for the time offset, s."""

DEGREES = 10.0
"""Multiple of the wheels' turn above which a yaw is in degrees instead of radians."""


class Heading(Struct, frozen=True):
    """The heading of a run as a sensor measures it, rad, at the sensor's own times."""

    t: Floats
    angle: Floats
    gaps: Floats


class Headings(Struct, frozen=True):
    """The headings of all runs, one each, and the values that they share."""

    source: str
    """Column of the log that the headings come from."""
    of: tuple[Heading, ...]
    late: float
    """Delay of the sensor's times behind the wheels' for the same event, s."""
    bias: float
    """Mean bias that was subtracted, rad/s."""
    drifts: bool
    """Whether the bias was not seen at rest, so that the fit has to find it."""
    unsure: float = 0.0
    """Standard deviation of the bias while the robot moves, rad/s.

    It is 0 if the sensor has no bias or if `drifts` is true.
    """


class Rows(Struct, frozen=True):
    """Turns over about a second each, by the sensor and by the wheels."""

    block: npt.NDArray[np.int64]
    turned: Floats
    """Turn by the sensor, rad."""
    left: Floats
    """Angle that the left wheels rolled, rad."""
    right: Floats
    fast: Floats
    """Integral of |right - left| (right - left), rad2/s.

    It reveals a track that grows with the turn rate.
    """
    seconds: Floats


def of_gyro(driven: Sequence[Run], angles: Sequence[Wheels]) -> Headings | None:
    """Return headings from the yaw rate, or None if no run has it.

    Raises `LogError` if the yaw rate never changes.
    """
    if not any(len(run.gyro) for run in driven):
        return None
    if all(np.ptp(run.gyro) == 0.0 for run in driven if len(run.gyro)):
        raise LogError("yaw_rate is the same in every row: the gyro was not recorded, or is dead")
    seen = [_biases(run) for run in driven]
    every = np.concatenate([values for _, values, _ in seen])
    usual = float(np.median(every)) if len(every) else 0.0
    found, rested = [], []
    for run, (t, values, noise) in zip(driven, seen, strict=True):
        true = np.abs(values - usual) < TURNED_BY_HAND
        rested.append((t[true], values[true], noise[true]))
        bias = np.interp(run.gyro_t, t[true], values[true]) if true.any() else usual
        rate = run.gyro - bias
        holes = gaps(run.gyro_t)
        steps = np.diff(run.gyro_t)
        steps[np.isin(run.gyro_t[:-1], holes[:, 0])] = 0.0
        found.append(Heading(run.gyro_t, _sums(rate, steps), holes))
    late = offset(found, angles)
    unsure = _unsure(rested, [float(run.t[-1]) for run in driven]) if len(every) else 0.0
    return Headings("yaw_rate", tuple(found), late, usual, not len(every), unsure)


def of_yaw(driven: Sequence[Run], angles: Sequence[Wheels], gain: float) -> Headings | None:
    """Return headings from the yaw of positions, or None if no run has it.

    Raises `LogError` if the yaw is in degrees, because it would be unwrapped in the wrong places.
    `gain` is about R / L, as configured.
    """
    if not any(len(run.yaw) for run in driven):
        return None
    found = []
    for run, turned in zip(driven, angles, strict=True):
        if _in_degrees(run, turned, gain):
            raise LogError("yaw is in degrees, but must be in radians: multiply it by pi / 180")
        angle = np.asarray(np.unwrap(run.yaw)) if len(run.yaw) else run.yaw
        found.append(Heading(run.yaw_t, angle, gaps(run.yaw_t)))
    return Headings("yaw", tuple(found), offset(found, angles), 0.0, drifts=False)


def _in_degrees(run: Run, turned: Wheels, gain: float) -> bool:
    if len(run.yaw) < 2 or np.ptp(run.yaw) < 3 * np.pi:
        return False
    steps = np.diff(run.yaw)
    if np.any((np.abs(steps) > 300.0) & (np.abs(steps) < 400.0)):
        return True
    left, right = turned.angles(run.yaw_t)
    wheels = gain * np.diff(right - left)
    small = np.abs(steps) < 100.0
    return float(np.sum(np.abs(steps[small]))) > DEGREES * float(np.sum(np.abs(wheels[small])))


Rests = tuple[Floats, Floats, Floats]
"""The rests of a run in which the gyro was recorded.

The arrays are the middle of each rest, s, the bias, rad/s, and the variance of the bias by noise.
"""


def _biases(run: Run) -> Rests:
    found = []
    for begin, end in rests(run, REST_S, EDGE_S):
        a, b = np.searchsorted(run.gyro_t, (begin, end))
        if b - a >= LEAST_SAMPLES:
            found.append(((begin + end) / 2, *_mean(run.gyro[a:b])))
    times, values, noise = np.array(found, dtype=np.float64).reshape(-1, 3).T
    return times, values, noise


def _mean(samples: Floats) -> tuple[float, float]:
    """Return the mean without outliers, and its variance; correlated noise is taken into account.

    The median is not used: that of a coarsely quantized gyro lies on one of its quantization steps.
    """
    off = np.abs(samples - np.median(samples))
    steps = np.diff(np.unique(samples))
    step = float(steps.min()) if len(steps) else 0.0
    kept = samples[off <= max(OUTLIER * float(np.median(off)), 1.01 * step)]
    kept = kept if len(kept) >= LEAST_SAMPLES else samples
    parts = [float(part.mean()) for part in np.array_split(kept, LEAST_SAMPLES)]
    few = step**2 / 12 if len(np.unique(kept)) <= 2 else 0.0
    return float(kept.mean()), float(np.var(parts, ddof=1)) / len(parts) + few


def _unsure(rested: Sequence[Rests], seconds: Sequence[float]) -> float:
    """Return the standard deviation of the mean bias over all drives, rad/s.

    It consists of noise in the rests and a random walk between them.
    """
    count = sum(len(t) for t, _, _ in rested)
    noise = sum(float(variance.sum()) for _, _, variance in rested) / max(1, count) ** 2
    walked = [np.column_stack((np.diff(v) ** 2 - n[1:] - n[:-1], np.diff(t))) for t, v, n in rested]
    gone, lasted = np.concatenate(walked).sum(axis=0)
    # An estimate from few differences is increased.
    few = 1 + 2 / max(1, count - len(rested))
    walk = max(WALK**2, few * gone / lasted) if lasted else UNSEEN_WALK**2
    # Between two rests the bias error is a Brownian bridge; outside of them it is a free random
    # walk.
    whole = sum(seconds)
    between = sum(float(np.sum(np.diff(t) ** 3)) for t, _, _ in rested) / 12
    outside = sum(
        (t[0] ** 3 + (last - t[-1]) ** 3) / 3 if len(t) else last**3 / 3
        for (t, _, _), last in zip(rested, seconds, strict=True)
    )
    return float(np.sqrt(noise + walk * (between + outside) / whole**2))


def _sums(rate: Floats, steps: Floats) -> Floats:
    return cumulative((rate[1:] + rate[:-1]) / 2 * steps) if len(rate) else rate


def offset(found: Sequence[Heading], angles: Sequence[Wheels]) -> float:
    """Return the delay of the sensor, s, at which its turn rate resembles the wheels' most.

    The turn rate of the wheels is the difference of both sides, or their sum in case one side is
    reversed.
    """
    reach = round(FURTHEST_S / GRID_S)
    scores, sizes = np.zeros((2, 2 * reach + 1)), np.zeros(2)
    for heading, turned in zip(found, angles, strict=True):
        grid = np.arange(turned.t[0], turned.t[-1], GRID_S)
        if len(heading.t) < 2 or len(grid) < 4:
            continue
        left, right = turned.angles(grid)
        sensor = np.diff(np.interp(grid, heading.t, heading.angle))
        sensor[~inside(grid[:-1], grid[1:], heading.gaps)] = 0.0
        sensor -= sensor.mean()
        for at, wheels in enumerate((np.diff(right - left), np.diff(right + left))):
            wheels = wheels - wheels.mean()
            scores[at] += _correlation(sensor, wheels, reach)
            sizes[at] += float(wheels @ wheels)
    alike = np.abs(scores) / np.sqrt(np.maximum(sizes, 1e-300))[:, None]
    score = alike[int(np.argmax(alike.max(axis=1)))]
    best = int(np.argmax(score))
    if not 0 < best < 2 * reach:
        return 0.0 if not score.any() else float(best - reach) * GRID_S
    before, top, after = score[best - 1 : best + 2]
    bend = before - 2 * top + after
    return float(best - reach + (0.5 * (before - after) / bend if bend else 0.0)) * GRID_S


def _correlation(later: Floats, earlier: Floats, reach: int) -> Floats:
    """Return the correlation of two series of equal length for shifts from -reach to reach."""
    size = 1 << (len(later) + reach).bit_length()
    spectrum = np.fft.rfft(later, size) * np.conj(np.fft.rfft(earlier, size))
    whole = np.fft.irfft(spectrum, size)
    return np.concatenate((whole[-reach:], whole[: reach + 1]))


def rows(
    headings: Headings | None,
    driven: Sequence[Run],
    angles: Sequence[Wheels],
    parts: Sequence[Block],
) -> Rows:
    """Return the rows of all blocks. Without a heading sensor they contain the wheels alone."""
    fast = [_fast(run, turned) for run, turned in zip(driven, angles, strict=True)]
    found: list[tuple[Floats, ...]] = []
    for number, part in enumerate(parts):
        count = max(1, round((part.end - part.begin) / ROW_S))
        edges = np.linspace(part.begin, part.end, count + 1)
        angle, whole = np.zeros(count + 1), np.ones(count, dtype=bool)
        if headings is not None:
            heading, seen = headings.of[part.run], edges + headings.late
            if not len(heading.t):
                continue
            angle = np.interp(seen, heading.t, heading.angle)
            whole = inside(seen[:-1], seen[1:], heading.gaps)
            whole &= (seen[:-1] >= heading.t[0]) & (seen[1:] <= heading.t[-1])
        left, right = angles[part.run].angles(edges)
        slow = np.interp(edges, driven[part.run].t, fast[part.run])
        series = (angle, left, right, slow, edges)
        found.append((np.full(count, number)[whole], *(np.diff(one)[whole] for one in series)))
    if not found:
        return Rows(np.zeros(0, dtype=np.int64), *[np.zeros(0)] * 5)
    block, *columns = (np.concatenate(column) for column in zip(*found, strict=True))
    return Rows(block.astype(np.int64), *columns)


def level(rows: Rows) -> Rows:
    """Remove from every column the part that a common bias would explain, for the fit."""
    share = rows.seconds / float(rows.seconds @ rows.seconds)
    turned, left, right, fast = (
        column - rows.seconds * float(share @ column)
        for column in (rows.turned, rows.left, rows.right, rows.fast)
    )
    return Rows(rows.block, turned, left, right, fast, rows.seconds)


def _fast(run: Run, turned: Wheels) -> Floats:
    apart = turned.apart(run.t)
    steps = np.minimum(np.diff(run.t), ROW_S)
    return _sums(np.abs(apart) * apart, steps)


NOISE = 0.01
"""Residuals that are usual when outliers are sought.

They are `NOISE` rad per second and the fraction `SHARE` of the turn, added as squares.
"""
SHARE = 0.03


def turned(rows: Rows, base: Base, parameters: Floats) -> Floats:
    """Return the turn of each row by the wheels for these parameters, rad."""
    left, right, turn, slope = parameters[[LEFT, RIGHT, TURN, RATE]]
    straight = base.gain * turn * (right * rows.right - left * rows.left)
    return np.asarray(straight + slope * _slower(rows, base, parameters))


def _slower(rows: Rows, base: Base, parameters: Floats) -> Floats:
    """Return the reduction of each row's turn per unit of `RATE`, rad."""
    left, right, turn = parameters[[LEFT, RIGHT, TURN]]
    rate = base.gain * turn * (left + right) / 2
    return np.asarray(-rate * abs(rate) * rows.fast)


def evidence(rows: Rows, base: Base, parameters: Floats, blocks: int) -> Evidence:
    """Return the evidence at these parameters."""
    turn = parameters[TURN]
    by_wheels = turned(rows, base, parameters)
    jacobian = np.zeros((len(rows.turned), COUNT))
    jacobian[:, LEFT] = -base.gain * turn * rows.left
    jacobian[:, RIGHT] = base.gain * turn * rows.right
    jacobian[:, RATE] = _slower(rows, base, parameters)
    jacobian[:, TURN] = (by_wheels + jacobian[:, RATE] * parameters[RATE]) / turn
    jacobian[:, DRIFT] = rows.seconds
    jacobian[:, STRETCH] = by_wheels
    gyro = by_wheels * (1 + parameters[STRETCH]) + parameters[DRIFT] * rows.seconds
    residual = rows.turned - gyro
    usual = np.hypot(NOISE * rows.seconds, SHARE * by_wheels)
    return of_rows(jacobian, residual, huber(residual / usual, 1.0), rows.block, blocks)


def bias(rows: Rows, by_wheels: Floats) -> float:
    """Return the rate by which the sensor exceeds the wheels, rad/s, by robust least squares."""
    seconds, found = rows.seconds, 0.0
    for _ in range(10):
        off = rows.turned - by_wheels
        usual = np.hypot(NOISE * seconds, SHARE * by_wheels)
        weight = huber((off - found * seconds) / usual, 1.0)
        found = float((weight * seconds) @ off / ((weight * seconds) @ seconds))
    return found


def first(rows: Rows, base: Base) -> Floats:
    """Return g_l and g_r, of any sign, by least squares.

    They are relative to the gain of parameters that are all 1.
    """
    columns = base.gain * np.column_stack((-rows.left, rows.right))
    weight = np.ones(len(rows.turned))
    found: Floats = np.zeros(2)
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        found = np.asarray(np.linalg.lstsq(columns * root, rows.turned * root[:, 0], rcond=None)[0])
        by_wheels = columns @ found
        usual = np.hypot(NOISE * rows.seconds, SHARE * by_wheels)
        weight = huber((rows.turned - by_wheels) / usual, 1.0)
    return found


def by_sides(rows: Rows, base: Base, sides: Floats) -> Floats:
    """Return the turn of each row by the wheels for the result of `first`, rad."""
    return np.asarray(base.gain * (sides[1] * rows.right - sides[0] * rows.left))
