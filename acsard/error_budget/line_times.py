"""How late each feedback line was held to be made, and how many are missing before it.

A microcontroller makes its lines evenly, or one for each line it is sent. Nothing reaches the host
before it was made, so of all lines within some time the promptest tells where the others belong;
once even that one comes a whole place later, a line is missing. What remains between a line's stamp
and its place is the error of its time.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

AHEAD = 30
"""Lines among which one is prompt: the longest stall of a host is 0.3 s."""

MISSING = 0.6
"""Places that even the promptest must come later."""

FOLLOWED = 0.05
"""Share of a new difference in where the prompt ones are: the period is known to 1 % at first."""

CLUSTERED, ALIKE = 0.4, 0.25
"""Lines that come one by one are mostly a period apart, within this share of it."""


class Places(Struct, frozen=True):
    """Of each line: `late` s after its place, 0 in the middle, and lines `missing` before it."""

    late: Floats
    missing: Counts
    period: float
    """s between two lines, the mean."""


def places(t: Floats, sent: Floats) -> Places:
    """Of lines with stamps `t`, s; `sent` is when lines left that may have asked for them.

    Of the two ways to make lines that one is taken that leaves the smaller errors. Needs 3 lines.
    """
    even = _even(t)
    asked = _asked(t, sent)
    if asked is None or np.ptp(t) == 0.0:
        return even
    return min(even, asked, key=lambda found: float(np.mean(np.abs(found.late))))


def _even(t: Floats) -> Places:
    """Made with an even period."""
    steps = np.diff(t)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    alike = np.abs(steps - usual) < ALIKE * usual
    period = usual if np.mean(alike) > CLUSTERED else mean
    missing = _missing((t - t[0]) / period if period > 0.0 else np.arange(len(t), dtype=float))
    number = np.arange(len(t)) + np.cumsum(missing)
    # Twice: a stall that pulls at the line through all is left out of the second.
    among = np.ones(len(t), dtype=bool)
    for _ in range(2):
        slope, start = np.polyfit(number[among], t[among], 1)
        late = t - (start + slope * number)
        among = np.abs(late - np.median(late)) <= 3 * np.std(late) + 1e-9
    return Places(late - np.median(late), missing, float(slope))


def _asked(t: Floats, sent: Floats) -> Places | None:
    """Each made for the line that left before it; None when no such lines are known."""
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
    """How many are missing before each line; `at` is where its stamp says that it belongs."""
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
