"""Finds the quantization step of reported wheel speeds.

A firmware may compute speeds from the encoder counts in each period T, s. It then reports only
multiples of the step q = 2 pi / (N T), rounded to two decimals, where N is the number of counts per
wheel turn. The search finds the largest q of which nearly all speeds are multiples. It rejects a q
that fits only by chance. If the firmware smooths the speeds with a filter, they are not multiples
of any step. If it reports means over M periods, the step is M times as fine.

A speed V among the largest speeds is V = j q for a whole number j. The candidates for q are
therefore V / j for j = 1, 2 and so on.
"""

from __future__ import annotations

import math

import numpy as np

from acsard.calibration.log_table import Floats
from acsard.core.link.whole_counts import ROUNDING

FINEST = 4 * ROUNDING
"""Finest step to try, rad/s. A finer step would fit more than half of all speeds by chance."""

DEVIATION = 0.01 / math.sqrt(12)
"""Standard deviation of the error of rounding to two decimals, rad/s."""

STRAYS = 0.005
"""Fraction of the speeds that may differ from all multiples of the step, due to damaged lines."""

BY_CHANCE = 1e-5
"""A step is rejected if its probability of fitting all speeds by chance exceeds this value."""

STEEP = 1.0
"""Smallest step, rad/s, that is accepted without a check against `BY_CHANCE`.

Only speeds from coarse encoders have steps of this size.
"""


def quantization_step(speeds: Floats) -> float:
    """Return the quantization step of these speeds, rad/s, or 0 if they have none.

    `speeds` contains at least three different speeds above 0, rad/s, in rising order.
    """
    spare = max(1, int(STRAYS * len(speeds)))
    # The largest speed, without the few that need not be multiples of the step.
    anchor = float(speeds[-1 - spare])
    for part in range(1, int(anchor / FINEST) + 1):
        # The anchor is rounded as well, so each multiple is wrong in proportion to its size.
        if _strays(speeds, anchor / part, ROUNDING / anchor) <= spare:
            step = _fitted(speeds, anchor / part, spare, part)
            if step:
                return step
    return 0.0


def _strays(speeds: Floats, step: float, doubt: float) -> int:
    """Count the speeds that are not multiples of `step`, except for rounding.

    `doubt` is the largest relative error of `step`.
    """
    off = np.abs(speeds - step * np.round(speeds / step))
    return int(np.count_nonzero(off > ROUNDING + doubt * speeds))


def _fitted(speeds: Floats, rough: float, spare: int, tries: int) -> float:
    """Fit the quantization step near `rough` by least squares, and return it, rad/s.

    Return 0 if the step is finer than `FINEST`, does not fit the speeds, or may fit only by chance.
    `spare` is the number of speeds that need not be multiples of the step. `tries` is the number of
    candidates tried so far, each of which could fit by chance.
    """
    whole = np.round(speeds / rough)
    near = np.abs(speeds - whole * rough) <= 2 * ROUNDING
    whole = whole[near]
    squares = float(whole @ whole)
    if not squares:
        return 0.0
    step, deviation = float(whole @ speeds[near]) / squares, DEVIATION / math.sqrt(squares)
    # A multiple j of the step is wrong by j times the error of the step.
    if step < FINEST or _strays(speeds, step, 4 * deviation / step) > spare:
        return 0.0
    by_chance = tries * (FINEST / step) ** (len(np.unique(whole)) - 1)
    return 0.0 if step < STEEP and by_chance > BY_CHANCE else step
