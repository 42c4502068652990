"""Estimates the error of wheel positions because a line carries speeds with two decimals.

Independent rounding has a standard deviation of q / sqrt(12), where q is the quantization step. A
wheel at a constant speed repeats the same error, so a run of equal values counts as one error of
the run's length. A run that a wheel passes on its way from slower to faster is different: the
errors of its two halves cancel.

A firmware that counts encoder edges in each period reports multiples of one count's speed. An edge
that it misses in one period is counted in the next, so only the rounding of each multiple adds up,
and that is known.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.drive.twist_uncertainty import DECIMAL

Floats = npt.NDArray[np.float64]

COARSE = 2.5 * DECIMAL
"""Smallest step in rad/s between multiples that can be distinguished from arbitrary two-decimal
values."""

FIT, SHARE = 0.0055, 0.99
"""Largest deviation of a rounded multiple in rad/s, and the share of values that must be within
it."""

CHANCE = 1e-3
"""Accepted probability that arbitrary speeds look like multiples of the step between two of
them."""

TOGETHER = 0.8
"""Share of lines with equal values from which two wheels are assumed to have the same error."""


class Rounding(Struct, frozen=True):
    """Rounding errors; rows are lines, columns are wheels in `values.WHEELS` order."""

    variance: Floats
    """Variance of each value, rad2; the entries are independent."""
    offset: Floats
    """Known excess of each value, rad."""
    alike: Floats
    """For each pair of wheels 1 if their errors are the same, otherwise 0."""
    quantum: float
    """Quantization step, rad/s."""
    count: float
    """Wheel rotation per encoder count, rad; 0 if the lines do not show it."""


def rounding(speeds: Floats, period: float) -> Rounding:
    """Estimate the rounding errors of wheel speeds in rad/s; each line covers `period` s."""
    moving = np.any(speeds != 0.0, axis=1)
    same = speeds[moving][:, :, None] == speeds[moving][:, None, :]
    alike = (same.mean(axis=0) >= TOGETHER).astype(float) if moving.any() else np.eye(4)
    lattice = _lattice(speeds)
    if lattice:
        off = (speeds - lattice * np.round(speeds / lattice)) * period
        return Rounding(np.zeros_like(speeds), off, alike, lattice, lattice * period)
    variance = np.column_stack([_runs(column) for column in speeds.T])
    scale = (DECIMAL * period) ** 2 / 12
    return Rounding(variance * scale, np.zeros_like(speeds), alike, DECIMAL, 0.0)


def _runs(values: Floats) -> Floats:
    """Return the variance of each run at its last line, in units of q^2 / 12.

    It is the square of the run's length, or 1 for a run that is passed through.
    """
    found = np.zeros(len(values))
    ends = np.append(np.flatnonzero(np.diff(values)), len(values) - 1)
    starts = np.append(0, ends[:-1] + 1)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if values[start] == 0.0:
            continue  # the wheel stands still
        length = end - start + 1
        if start > 0 and end + 1 < len(values):
            before, after = values[start - 1] - values[start], values[end + 1] - values[start]
            length = 1 if before * after < 0.0 else length
        found[end] = length**2
    return found


def _lattice(speeds: Floats) -> float:
    """Return the speed in rad/s of which all speeds are multiples, or 0 if there is none."""
    values = np.unique(np.append(np.abs(speeds), 0.0))
    step = float(np.min(np.diff(values), initial=math.inf))
    if not COARSE <= step < math.inf or (2 * FIT / step) ** (len(values) - 2) > CHANCE:
        return 0.0
    apart = np.diff(values)
    # Most neighbours are one step apart. Their mean is precise enough to number the distant values.
    step = float(apart[apart < 1.5 * step].mean())
    for _ in range(2):
        number = np.round(values / step)
        step = float(values @ number / (number @ number))
    off = np.abs(values - step * np.round(values / step))
    return step if float(np.mean(off <= FIT)) >= SHARE else 0.0
