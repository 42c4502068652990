"""Removes impossible values from a log, and counts and reports them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from acsard.formatting import many

Floats = npt.NDArray[np.float64]

WHEELS = ("fr", "fl", "rl", "rr", "left", "right")

BOUNDS = dict.fromkeys(WHEELS, 1e3) | {"t": 1e20, "yaw_rate": 1e4, "yaw": 1e7}
PLACE_BOUND = 1e9
"""Bounds above which a value is impossible (rad/s, s, rad, m).

They are wide enough for degrees and nanoseconds, so that later checks can name the wrong unit.
"""

RATES = frozenset((*WHEELS, "yaw_rate"))
SPIKE, FEW, SLOW = 10.0, 0.02, 0.02
"""Definition of a spike, which is a misread number.

It is more than `SPIKE` times as large as each neighbour and as the usual speed. Of the rates over
`SLOW` rad/s, all but the fraction `FEW` stay below the usual speed. A robot that stands for nearly
the whole log also turns much faster than that, but never for a single sample.
"""


def bounded(columns: dict[str, Floats]) -> Iterator[str]:
    """Replace impossible values with NaN in place. Yield a sentence for each column with any."""
    order = np.argsort(columns["t"], kind="stable")
    for name, values in columns.items():
        with np.errstate(invalid="ignore"):
            wild = np.abs(values) > BOUNDS.get(name, PLACE_BOUND)
        if name in RATES:
            wild |= _spikes(np.where(wild, math.nan, values), order)
        if wild.any():
            example = float(values[wild][0])
            values[wild] = math.nan
            cells = many(int(wild.sum()), "cell")
            yield f"{cells} of {name} left out as impossible, like {example:g}"


def _spikes(values: Floats, order: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return a mask of the rows that are spikes; `order` sorts the rows by time.

    A spike stands out among its neighbours both in the file and in time. In a shuffled file, or one
    of several drives, a true turn stands out in only one of them.
    """
    sizes = np.abs(values)
    moving = sizes[sizes > SLOW]
    if len(moving) < 1 / FEW:
        return np.zeros(len(values), dtype=bool)
    usual = float(np.quantile(moving, 1 - FEW))
    wild = _alone(sizes, usual)
    wild[order] &= _alone(sizes[order], usual)
    return wild


def _alone(sizes: Floats, usual: float) -> npt.NDArray[np.bool_]:
    """Return a mask of the values far above `usual` and above both neighbours.

    Missing values are skipped in the search for a neighbour.
    """
    held = np.flatnonzero(np.isfinite(sizes))
    seen = np.concatenate([[0.0], sizes[held], [0.0]])
    around = np.maximum(np.maximum(seen[:-2], seen[2:]), usual)
    found = np.zeros(len(sizes), dtype=bool)
    found[held[seen[1:-1] > SPIKE * around]] = True
    return found
