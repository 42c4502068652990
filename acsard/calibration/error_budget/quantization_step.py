"""Finds the quantization step of reported wheel speeds.

A firmware may compute speeds from the encoder counts in each period T, s. It then reports only
multiples of the step q = 2 pi / (N T), rounded to two decimals. N is the number of counts per wheel
turn. If the firmware reports means over M periods, q is M times smaller. If the firmware smooths
the speeds with a filter, the speeds are not multiples of any step.
"""

from __future__ import annotations

import math

import numpy as np

from acsard.calibration.log_table import Floats
from acsard.core.link.whole_counts import ROUNDING

MIN_STEP = 4 * ROUNDING
"""Smallest quantization step to try, rad/s.

A smaller step would fit more than half of all speeds by chance.
"""

ROUNDING_STD = 0.01 / math.sqrt(12)
"""Standard deviation of the error of rounding to two decimals, rad/s."""

MAX_OUTLIER_FRACTION = 0.005
"""Fraction of the speeds that may differ from multiples of the step, because a line was damaged."""

MAX_CHANCE = 1e-5
"""Largest accepted probability that a quantization step fits all speeds only by chance."""

COARSE_STEP = 1.0
"""Smallest quantization step, rad/s, that is accepted without a check against `MAX_CHANCE`.

Only speeds from coarse encoders have steps of this size.
"""


def quantization_step(speeds: Floats) -> float:
    """Return the quantization step of wheel speeds, rad/s, or 0 if no step fits.

    `speeds` contains at least three different speeds above 0, rad/s, in rising order. A step fits
    if nearly all speeds are multiples of it, and if this is hardly possible by chance. If several
    steps fit, the result is the largest of them.
    """
    spare = max(1, int(MAX_OUTLIER_FRACTION * len(speeds)))
    # The anchor is one of the largest speeds. It is j times the step for a whole number j, so the
    # candidates for the step are anchor / j. The speeds above the anchor need not be multiples of
    # the step.
    anchor = float(speeds[-1 - spare])
    for part in range(1, int(anchor / MIN_STEP) + 1):
        # The anchor is rounded too, so the error of each multiple is proportional to its size.
        if _non_multiples(speeds, anchor / part, ROUNDING / anchor) <= spare:
            step = _fitted(speeds, anchor / part, spare, part)
            if step:
                return step
    return 0.0


def _non_multiples(speeds: Floats, step: float, relative_error: float) -> int:
    """Return how many speeds are not multiples of `step`.

    `relative_error` is the largest relative error of `step`.
    """
    off = np.abs(speeds - step * np.round(speeds / step))
    return int(np.count_nonzero(off > ROUNDING + relative_error * speeds))


def _fitted(speeds: Floats, rough: float, spare: int, tries: int) -> float:
    """Refine the quantization step `rough`, rad/s, by least squares. Return 0 if no step fits.

    The step fits if at most `spare` speeds are not multiples of it. `tries` is the number of
    candidates that were tried so far. Each further candidate makes a fit by chance more likely.
    """
    whole = np.round(speeds / rough)
    near = np.abs(speeds - whole * rough) <= 2 * ROUNDING
    whole = whole[near]
    squares = float(whole @ whole)
    if not squares:
        return 0.0
    step, deviation = float(whole @ speeds[near]) / squares, ROUNDING_STD / math.sqrt(squares)
    # A multiple j of the step is wrong by j times the error of the step.
    if step < MIN_STEP or _non_multiples(speeds, step, 4 * deviation / step) > spare:
        return 0.0
    by_chance = tries * (MIN_STEP / step) ** (len(np.unique(whole)) - 1)
    return 0.0 if step < COARSE_STEP and by_chance > MAX_CHANCE else step
