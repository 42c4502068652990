"""Cells that cannot be a measurement: made missing, counted and told."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

WHEELS = ("fr", "fl", "rl", "rr", "left", "right")

BOUNDS = dict.fromkeys(WHEELS, 1e3) | {"t": 1e20, "yaw_rate": 1e4, "yaw": 1e7}
PLACE_BOUND = 1e9
"""Greater ones are no measurement (rad/s, s, rad, m); degrees and ns must come through to be
told."""

RATES = frozenset((*WHEELS, "yaw_rate"))
SPIKE, FEW, SLOW = 10.0, 0.02, 0.02
"""Times what all but this share of the rates over so many rad/s stay below, and times each
neighbour: a misread number. Whoever stands nearly all day turns as fast, but not for one sample."""


def bounded(columns: dict[str, Floats]) -> Iterator[str]:
    """Make what cannot be a measurement missing, in place; what was."""
    order = np.argsort(columns["t"], kind="stable")
    for name, values in columns.items():
        with np.errstate(invalid="ignore"):
            wild = np.abs(values) > BOUNDS.get(name, PLACE_BOUND)
        if name in RATES:
            wild |= _spikes(np.where(wild, math.nan, values), order)
        if wild.any():
            example = float(values[wild][0])
            values[wild] = math.nan
            count = int(wild.sum())
            cells = f"{count} cell{'s' if count > 1 else ''}"
            yield f"{cells} of {name} left out as impossible, like {example:g}"


def _spikes(values: Floats, order: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which rates all others are far below; `order` is that of time.

    Alone among its neighbours in the file and in time: in a shuffled file, or one of several
    drives, a true turn has its like beside it in one of both only.
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
    """Far over what is usual, and over its neighbours that are not missing."""
    held = np.flatnonzero(np.isfinite(sizes))
    seen = np.concatenate([[0.0], sizes[held], [0.0]])
    around = np.maximum(np.maximum(seen[:-2], seen[2:]), usual)
    found = np.zeros(len(sizes), dtype=bool)
    found[held[seen[1:-1] > SPIKE * around]] = True
    return found
