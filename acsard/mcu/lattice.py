"""Are speeds whole counts per period? The lattice they lie on, found in a bounded search.

A firmware that divides counts by its period reports only multiples of q = 2 pi / (counts T), in two
decimals. The largest q counts of which nearly all speeds are multiples; one that chance could have
made of them is none, and what a filter makes of counts lies anywhere. (A mean of M periods has a
lattice M times as fine: it counts in M-ths.)

One speed V of them is j q for some whole j, so V / j for j = 1, 2 ... are all that q can be. Most
are refused by the first speed they are tried on. The search stops after a few trials and goes on
when it is asked again, so that no step waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from msgspec import Struct

ROUNDING = 0.0052
"""rad/s a speed in two decimals is off at the most."""

FINEST = 4 * ROUNDING
"""rad/s; of a finer lattice half of all speeds lie on it by chance."""

DEVIATION = 0.01 / math.sqrt(12)
"""rad/s, of rounding to two decimals."""

STRAYS = 0.005
"""Share of the speeds that may lie elsewhere: damaged lines."""

BY_CHANCE = 1e-5
"""How likely a lattice may be that is none."""

STEEP = 1.0
"""rad/s; no wheel steps to and fro by so much from line to line but for its encoder's sake."""

TRIALS = 16
"""Speeds tried before the search lets the step go on."""

NOT_ONE_OF_THEM = 0.4
"""How well, in counts a turn, their number must be known to be a whole one."""

LEAST_DOUBT = 0.02
"""Counts a turn by which a whole number may seem off: of a period in whole milliseconds."""


class Lattice(Struct, frozen=True):
    """All speeds are multiples of `quantum`, which is known to `deviation`; both rad/s."""

    quantum: float
    deviation: float

    def counts(self, period: float) -> int:
        """Counts per turn by which a firmware divides `period` s; 0 if that is no whole number."""
        exact = math.tau / (self.quantum * period)
        doubt = max(LEAST_DOUBT, 3 * exact * self.deviation / self.quantum)
        near = doubt <= NOT_ONE_OF_THEM and abs(exact - round(exact)) <= doubt
        return round(exact) if near else 0


class Search:
    """For the lattice of these speeds, in slices.

    No generator: what a robot has in hand must be bytes at any moment (`record/state.py`).
    """

    def __init__(self, seen: Mapping[float, int]) -> None:
        """`seen`: speeds, rad/s above 0, and how often each was."""
        self.found: Lattice | None = None
        """Once it is over: the lattice, None if there is none."""
        self._seen = seen
        self._speeds: list[float] = []
        self._spare = self._part = self._tried = 0
        self._anchor = 0.0
        self._fits = False
        """All speeds lie on the lattice at hand: the next slice takes a closer look."""

    def go_on(self) -> bool:
        """Do a slice of the work; whether it is over."""
        if not self._speeds:
            self._speeds = sorted(self._seen)
            self._spare = max(1, int(STRAYS * sum(self._seen.values())))
            self._anchor = _anchor(self._speeds, self._seen, self._spare)
        for _ in range(2 * TRIALS):  # never so often, unless a stranger has made it
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
        """All speeds but a few are multiples of it, roughly."""
        strays, slope = 0, ROUNDING / self._anchor
        for speed in self._speeds:
            self._tried += 1
            off = abs(speed - quantum * round(speed / quantum))
            # The anchor is rounded too, and speeds are off by their share of that.
            if off > ROUNDING + slope * speed:
                strays += self._seen[speed]
                if strays > self._spare:
                    return False
        return True


def _anchor(speeds: list[float], seen: Mapping[float, int], spare: int) -> float:
    """The largest speed that is not one of the few that may lie elsewhere."""
    above = 0
    for speed in reversed(speeds):
        above += seen[speed]
        if above > spare:
            return speed
    return speeds[-1]


def _fitted(seen: Mapping[float, int], rough: float, spare: int, tries: int) -> Lattice | None:
    """The lattice near `rough` by least squares, if it stands a closer look."""
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
    # A multiple is off by as many times what the quantum is.
    off = (n for speed, n in seen.items() if not on(speed, quantum, 4 * deviation / quantum))
    if sum(off) > spare:
        return None
    by_chance = tries * (FINEST / quantum) ** (len(points) - 1)
    if quantum < STEEP and by_chance > BY_CHANCE:
        return None
    return Lattice(quantum, deviation)


def on(speed: float, quantum: float, doubt: float = 0.0) -> bool:
    """A speed in two decimals is a multiple of `quantum`, of which a share of `doubt` is unsure."""
    return abs(speed - quantum * round(speed / quantum)) <= ROUNDING + doubt * abs(speed)
