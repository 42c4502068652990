"""Finds the quantization step of a wheel's reported speeds, in a bounded search.

A firmware that divides counts by its period reports only multiples of q = 2 pi / (counts T), in two
decimals. The search finds the largest q of which nearly all speeds are multiples. It rejects a q
that chance could have produced. Speeds that a filter has smoothed are not multiples of any step.
(A mean over M periods has a step that is M times as fine, as if it counted in M-ths.)

Some speed V is j q for a whole j, so the candidates are V / j for j = 1, 2 and so on. The first
speeds that are tried reject most of them. The search pauses after a few trials and continues when
it is called again, so no control step waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from msgspec import Struct

ROUNDING = 0.0052
"""Largest rounding error of a speed in two decimals, rad/s."""

FINEST = 4 * ROUNDING
"""Finest step that is searched, rad/s. Half of all speeds fit a finer step by chance."""

DEVIATION = 0.01 / math.sqrt(12)
"""Standard deviation of the rounding to two decimals, rad/s."""

STRAYS = 0.005
"""Share of the speeds that need not be multiples of the step, because of damaged lines."""

BY_CHANCE = 1e-5
"""Highest probability that chance has produced an accepted step."""

STEEP = 1.0
"""rad/s. A wheel's speed alternates by this much from line to line only because of its encoder, so
no test against chance is needed."""

TRIALS = 16
"""Speeds that are tried before the search pauses."""

NOT_ONE_OF_THEM = 0.4
"""Largest uncertainty, in counts per turn, at which a number of counts can be recognized as
whole."""

LEAST_DOUBT = 0.02
"""Least uncertainty in counts per turn, for a period that is rounded to whole milliseconds."""


class Quantization(Struct, frozen=True):
    """The quantization of speeds that are multiples of `quantum`.

    The standard deviation of `quantum` is `deviation`. Both are in rad/s.
    """

    quantum: float
    deviation: float

    def counts(self, period: float) -> int:
        """Return the counts per turn of a firmware that divides by `period` s, 0 if not whole."""
        exact = math.tau / (self.quantum * period)
        doubt = max(LEAST_DOUBT, 3 * exact * self.deviation / self.quantum)
        near = doubt <= NOT_ONE_OF_THEM and abs(exact - round(exact)) <= doubt
        return round(exact) if near else 0


class Search:
    """The search for the quantization of some speeds, in slices.

    It is not a generator, because a robot's whole state must be serializable at any moment
    (`recording/state.py`).
    """

    def __init__(self, seen: Mapping[float, int]) -> None:
        """Start; `seen` maps speeds above 0, rad/s, to the number of their occurrences."""
        self.found: Quantization | None = None
        """The result when the search is over; None if the speeds are not quantized."""
        self._seen = seen
        self._speeds: list[float] = []
        self._spare = self._part = self._tried = 0
        self._anchor = 0.0
        self._fits = False
        """Whether all speeds lie on the present candidate. The next slice fits it."""

    def go_on(self) -> bool:
        """Do a slice of the work; return whether the search is over."""
        if not self._speeds:
            self._speeds = sorted(self._seen)
            self._spare = max(1, int(STRAYS * sum(self._seen.values())))
            self._anchor = _anchor(self._speeds, self._seen, self._spare)
        for _ in range(2 * TRIALS):  # a bound that only a forged state could reach
            if self._fits:
                self._fits = False
                quantum = self._anchor / self._part
                self.found = _fitted(self._seen, quantum, self._spare, self._part)
                if self.found is not None:
                    return True
            else:
                self._part += 1
                if self._part > int(self._anchor / FINEST):
                    return True
                if self._all_on(self._anchor / self._part):
                    self._fits = True
                    return False
            if self._tried >= TRIALS:
                break
        self._tried = 0
        return False

    def _all_on(self, quantum: float) -> bool:
        """Return whether all speeds except a few are roughly multiples of `quantum`."""
        strays, slope = 0, ROUNDING / self._anchor
        for speed in self._speeds:
            self._tried += 1
            off = abs(speed - quantum * round(speed / quantum))
            # The anchor is rounded too, and each speed is off by its share of that.
            if off > ROUNDING + slope * speed:
                strays += self._seen[speed]
                if strays > self._spare:
                    return False
        return True


def _anchor(speeds: list[float], seen: Mapping[float, int], spare: int) -> float:
    """Return the largest speed, without the few that need not be multiples of the step."""
    above = 0
    for speed in reversed(speeds):
        above += seen[speed]
        if above > spare:
            return speed
    return speeds[-1]


def _fitted(seen: Mapping[float, int], rough: float, spare: int, tries: int) -> Quantization | None:
    """Return the quantization near `rough` by least squares, None if it fails the closer tests."""
    squares = products = 0.0
    points = set()
    for speed in seen:
        whole = round(speed / rough)
        if abs(speed - whole * rough) <= 2 * ROUNDING:
            squares += whole * whole
            products += whole * speed
            points.add(whole)
    if not squares:
        return None
    quantum, deviation = products / squares, DEVIATION / math.sqrt(squares)
    if quantum < FINEST:
        return None
    # A multiple is off by the quantum's error times the factor.
    off = (n for speed, n in seen.items() if not on(speed, quantum, 4 * deviation / quantum))
    if sum(off) > spare:
        return None
    by_chance = tries * (FINEST / quantum) ** (len(points) - 1)
    if quantum < STEEP and by_chance > BY_CHANCE:
        return None
    return Quantization(quantum, deviation)


def on(speed: float, quantum: float, doubt: float = 0.0) -> bool:
    """Return whether a speed in two decimals is a multiple of `quantum`.

    `doubt` is the relative error of `quantum`.
    """
    return abs(speed - quantum * round(speed / quantum)) <= ROUNDING + doubt * abs(speed)
