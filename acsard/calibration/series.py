"""Tells whether a series of values is one, or is mixed of those of two sensors or programs.

A log does not say who wrote a row. Two writers show by values that jump to and fro: in turns, by
chance, or for some seconds each. A coarse encoder jumps, too, but by the same step at any speed,
and it does not jump in the same rows as the other side.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]
Mask = npt.NDArray[np.bool_]

TINY = 1e-9  # beside a divisor that may be 0

MIN_ROWS = 8
BACK, NOISES = 0.2, 12.0  # of the jump to a wrong value; of the quartile of all jumps
FAR_SHARES, FAR_STEPS = 3.0, 5.0  # of the range of the values; of the usual step of positions

# Of 6,720 simulated sides (16 to 3,200 counts, 10 to 100 Hz), 5 look like two series by these, and
# none together with the other side. Of two series in one side, 6 in 10 are found.
CYCLE_ROWS, CYCLES, MIN_BLOCKS = range(2, 8), 6, 3  # rows of a cycle; cycles of a block; blocks
MOVING, STILL, OTHER_SHARE = 0.3, 0.002, 0.15  # of the usual speed, twice; of the present speed
STEPS, MEAN_DEVIATIONS = 1.2, 4.0  # jumps at slow speeds; standard deviations of the mean
MAX_OTHER, MIN_MOVING = 0.3, 5  # share of the blocks that move; and so many of them

# Sides that jump by one factor in the same rows. Of coarse encoders whose board samples within a
# tenth of its period, up to 0.86 of few jumps have one factor; of two writers, 0.94 and more.
SAME, MOVED, SPEED_RATIO, JUMP, ONE_FACTOR = 0.1, 0.1, 1.3, 0.15, 0.9
MIN_JUMPS, JUMPS = 30, 0.04

# A series has two levels beside another if this share of its rows is near one of them, this share
# near the rarer one, and they are apart by so many of their spreads and this share of the larger.
# Sound gyros: 0.57, 3 spreads, 3 changes. Two by turns: 1.0, 20 spreads, 6 changes and more.
NEAR, RARER, SPREADS, LEVELS_APART, CHANGES = 0.7, 0.1, 8.0, 0.2, 6
FAST, STEADY, MIN_FAST, ROUNDS = 0.3, 0.05, 20, 12  # share of the usual size; of the present one


def apart(values: Floats | Complexes) -> Mask:
    """Return a mask of single values that are wrong: a jump leads there, and the next one back."""
    mask = np.zeros(len(values), dtype=bool)
    if len(values) < MIN_ROWS:
        return mask
    jumps = np.abs(np.diff(values))
    least = (
        max(NOISES * float(np.quantile(jumps, 0.25)), FAR_STEPS * float(np.median(jumps)))
        if np.iscomplexobj(values)
        else FAR_SHARES * float(np.quantile(np.abs(values), 0.95))
    )
    mask[1:-1] = np.minimum(jumps[1:], jumps[:-1]) > least
    mask[1:-1] &= np.abs(values[2:] - values[:-2]) < BACK * jumps[:-1]
    return mask


def by_turns(*columns: Floats | Complexes) -> bool:
    """Return whether in the same rows of a short cycle, all columns have values of another series.

    A coarse encoder jumps to and fro by the same step at any speed. Of two series, the difference
    grows with the speed. Rates are real; positions and directions are complex.
    """
    values = np.array(columns)
    places, size = np.iscomplexobj(values), np.abs(values)
    usual = np.quantile(size, 0.95, axis=1)[:, None] if size.size else size
    for period in CYCLE_ROWS:
        half, count = period // 2, (values.shape[1] - period) // (period * CYCLES)
        if count < MIN_BLOCKS:
            break
        kernel = np.full(2 * half + 1, 1 / period)
        kernel[[0, -1]] *= 1.0 if period % 2 else 0.5
        smooth = np.array([np.convolve(column, kernel, "same") for column in values])
        off, sizes = (
            v[:, half : half + count * period * CYCLES].reshape(-1, count, CYCLES, period)
            for v in (values - smooth, size)
        )
        mean, speed = off.mean(axis=2), sizes.mean(axis=(2, 3))
        least = np.median(np.abs(values[:, period:] - values[:, :-period]), axis=1)[:, None]
        moves = np.full(speed.shape, places)
        if not places:
            moves = speed > MOVING * usual
            slow = ~moves & (speed > STILL * usual)
            jumps = np.abs(off).max(axis=(2, 3))
            step = [np.median(j[s]) if s.sum() > 1 else u / 2
                    for j, s, u in zip(jumps, slow, usual[:, 0], strict=True)]  # fmt: skip
            least = np.maximum(OTHER_SHARE * speed, STEPS * np.array(step)[:, None])
        spread = np.sqrt((np.abs(off - mean[:, :, None]) ** 2).mean(axis=2) / CYCLES)
        other = np.abs(mean) > np.maximum(MEAN_DEVIATIONS * spread, least[:, :, None])
        blocks = (other & moves[:, :, None]).all(axis=0).any(axis=1).sum()
        if blocks > MAX_OTHER * max(MIN_MOVING, moves.all(axis=0).sum()):
            return True
    return False


def by_chance(columns: Floats) -> bool:
    """Return whether columns of shape (n, rows) jump by one factor in the same rows, and back.

    Only rows count in which the columns have different speeds, and the rows beside them agree.
    """
    usual = MOVED * np.quantile(np.abs(columns), 0.95, axis=1)[:, None] if columns.size else 0.0
    last, now, after = columns[:, :-2], columns[:, 1:-1], columns[:, 2:]
    size = np.minimum(np.abs(last), np.abs(after))
    steady = ((np.abs(after - last) < SAME * size) & (size > usual)).all(axis=0)
    steady &= size.max(axis=0) > SPEED_RATIO * size.min(axis=0)
    factors = 2 * now[:, steady] / (last + after)[:, steady]
    factor = factors.mean(axis=0)
    jumps = np.abs(factor - 1) > np.maximum(JUMP, np.ptp(factors, axis=0) / SAME)
    if jumps.sum() < max(MIN_JUMPS, JUMPS * len(factor)):
        return False
    factor = factor[jumps]
    factor = np.where(np.abs(factor) > 1, 1 / np.where(factor, factor, 1), factor)
    middle = float(np.median(factor))
    return bool((np.abs(factor - middle) < SAME * abs(middle - 1)).mean() > ONE_FACTOR)


class Levels(Struct, frozen=True):
    """The two shares of another series that a series has in turn."""

    low: float
    high: float
    changes: int  # from one to the other while the other series stays


def in_blocks(values: Floats, other: Floats) -> Levels | None:
    """Return two shares of `other` that `values` have in turn, or None if there is one share."""
    size = np.abs(other)
    usual = float(np.quantile(size, 0.9)) if len(size) else 0.0
    fast = np.flatnonzero(size > max(1e-6, FAST * usual))
    if len(fast) < MIN_FAST:
        return None
    share = values[fast] / other[fast]
    low, high = np.quantile(share, [RARER, 1 - RARER])
    for _ in range(ROUNDS):
        upper = share > (low + high) / 2
        if not upper.any():
            return None
        low, high = np.median(share[~upper]), np.median(share[upper])
    off, distance = np.abs(share - np.where(upper, high, low)), float(high - low)
    spread = 1.48 * max(float(np.median(off[upper])), float(np.median(off[~upper])))
    near = off < distance / 4
    rows, upper = fast[near], upper[near]
    kept = np.abs(np.diff(other[rows])) < STEADY * size[rows[1:]]
    changes = int(((np.diff(upper.astype(int)) != 0) & (np.diff(rows) < 4) & kept).sum())
    if (
        near.mean() < NEAR or min(upper.mean(), 1 - upper.mean()) < RARER or changes < CHANGES
        or distance < max(SPREADS * spread, LEVELS_APART * max(abs(low), abs(high)))
    ):  # fmt: skip
        return None
    return Levels(float(low), float(high), changes)
