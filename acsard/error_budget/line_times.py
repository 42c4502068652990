"""Estimates how late the stamp of each feedback line is, and how many lines are missing before it.

A microcontroller sends its lines either at a fixed period or as answers to the host's lines. A line
cannot arrive before it was made. So the earliest line among its neighbours, relative to the
expected grid, shows where the grid is. If even the earliest one is a whole place later, a line is
missing. The remaining difference between a line's stamp and its place on the grid is the error of
its time.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

AHEAD = 30
"""Number of lines of which at least one is not delayed; the longest stall of a host is 0.3 s."""

MISSING = 0.6
"""Delay of the earliest line, in places, from which a line counts as missing."""

FOLLOWED = 0.05
"""Share of a new delay that corrects the grid, because the period is known to about 1 % at
first."""

CLUSTERED, ALIKE = 0.4, 0.25
"""Criterion for lines that arrive one by one: this share of the intervals is close to the median,
within this relative tolerance."""


class Places(Struct, frozen=True):
    """Estimates for each line.

    `late` is its delay in s relative to the median, and `missing` the number of lines missing
    before it.
    """

    late: Floats
    missing: Counts
    period: float
    """Mean interval between two lines, s."""


def places(t: Floats, sent: Floats) -> Places:
    """Estimate the delays of at least 3 lines with stamps `t` (s).

    `sent` holds the times (s) of the host's lines. Both ways to send lines are tried, and the one
    with the smaller errors is returned.
    """
    even = _even(t)
    asked = _asked(t, sent)
    if asked is None or np.ptp(t) == 0.0:
        return even
    return min(even, asked, key=lambda found: float(np.mean(np.abs(found.late))))


def _even(t: Floats) -> Places:
    """Estimate the delays of lines with a fixed period."""
    steps = np.diff(t)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    alike = np.abs(steps - usual) < ALIKE * usual
    period = usual if np.mean(alike) > CLUSTERED else mean
    missing = _missing((t - t[0]) / period if period > 0.0 else np.arange(len(t), dtype=float))
    number = np.arange(len(t)) + np.cumsum(missing)
    # Fit twice: the second fit leaves out stalls that distorted the first line.
    among = np.ones(len(t), dtype=bool)
    for _ in range(2):
        slope, start = np.polyfit(number[among], t[among], 1)
        late = t - (start + slope * number)
        among = np.abs(late - np.median(late)) <= 3 * np.std(late) + 1e-9
    return Places(late - np.median(late), missing, float(slope))


def _asked(t: Floats, sent: Floats) -> Places | None:
    """Estimate the delays of lines that answer the host's lines; None if those are unknown."""
    if len(sent) < 3 or sent[0] > t[0] or len(sent) < len(t) / 2:
        return None
    at = np.interp(t, sent, np.arange(len(sent)))
    missing = _missing(at)
    number = np.arange(len(t)) + np.cumsum(missing)
    first = int(np.floor(np.quantile(at - number, 0.05)))
    number = number + first
    if number[0] < 0 or number[-1] >= len(sent):
        return None
    late = t - sent[number]
    return Places(late - np.median(late), missing, float(np.mean(np.diff(sent))))


def _missing(at: Floats) -> Counts:
    """Return the number of missing lines before each line.

    `at` is the place on the grid that each line's stamp suggests.
    """
    count = len(at)
    ahead = at - np.arange(count)
    padded = np.concatenate([ahead, np.full(AHEAD, np.inf)])
    promptest = np.lib.stride_tricks.sliding_window_view(padded, AHEAD)[:count].min(axis=1)
    found = np.zeros(count, dtype=np.int64)
    usual = float(promptest[0])
    for i, now in enumerate(promptest.tolist()):
        over = now - usual
        if over >= MISSING:
            found[i] = round(over)
            usual += round(over)
        else:
            usual += FOLLOWED * over
    return found
