"""What wheels turned more or less than their lines said, because a line has two decimals.

A value that is rounded anew each time errs by q / sqrt(12), q being the quantum. While a wheel goes
on at one speed the same error is made again and again, so a run of equal values counts as one error
as long as the run; not one that the wheel passes through on its way from slower to faster, where
the errors of its two halves cancel each other.

A firmware that counts its encoder's edges in each period reports multiples of one count's speed.
What it forgets to count in one period it counts in the next, so all that adds up is the rounding of
each multiple, and that can be told.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.drive.twist_uncertainty import DECIMAL

Floats = npt.NDArray[np.float64]

COARSE = 2.5 * DECIMAL
"""rad/s; multiples of less cannot be told from any two decimals."""

FIT, SHARE = 0.0055, 0.99
"""rad/s that a rounded multiple may be off, and how many of the values must be no further."""

CHANCE = 1e-3
"""That any speeds would look like multiples of the step between two of them."""

TOGETHER = 0.8
"""Share of the lines from which on two wheels that say the same make the same error."""


class Rounding(Struct, frozen=True):
    """Rows are lines, columns wheels in `values.WHEELS` order."""

    variance: Floats
    """rad2, independent from line to line."""
    offset: Floats
    """rad that are known to be said too much."""
    alike: Floats
    """Of each pair of wheels 1 where their errors are one and the same, else 0."""
    quantum: float
    """rad/s"""
    count: float
    """rad that a wheel turns in a count, 0 where lines do not show it."""


def rounding(speeds: Floats, period: float) -> Rounding:
    """Of the wheel speeds in lines, rad/s, each of which stands for `period` s."""
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
    """In q2 / 12: the square of each run's length at its end, 1 for one that is passed through."""
    found = np.zeros(len(values))
    ends = np.append(np.flatnonzero(np.diff(values)), len(values) - 1)
    starts = np.append(0, ends[:-1] + 1)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if values[start] == 0.0:
            continue  # it stands
        length = end - start + 1
        if start > 0 and end + 1 < len(values):
            before, after = values[start - 1] - values[start], values[end + 1] - values[start]
            length = 1 if before * after < 0.0 else length
        found[end] = length**2
    return found


def _lattice(speeds: Floats) -> float:
    """The speed that all are multiples of, rad/s; 0 when there is none that two decimals show."""
    values = np.unique(np.append(np.abs(speeds), 0.0))
    step = float(np.min(np.diff(values), initial=math.inf))
    if not COARSE <= step < math.inf or (2 * FIT / step) ** (len(values) - 2) > CHANCE:
        return 0.0
    apart = np.diff(values)
    # Most neighbours are a step apart: their mean is good enough to number what is far from 0.
    step = float(apart[apart < 1.5 * step].mean())
    for _ in range(2):
        number = np.round(values / step)
        step = float(values @ number / (number @ number))
    off = np.abs(values - step * np.round(values / step))
    return step if float(np.mean(off <= FIT)) >= SHARE else 0.0
