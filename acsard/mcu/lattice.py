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
from collections.abc import Generator, Mapping

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


Search = Generator[None, None, Lattice | None]
"""Each `next` is a slice of the work; it returns what it has found."""


def search(seen: Mapping[float, int]) -> Search:
    """The lattice of these speeds, rad/s above 0, and how often each was seen; None if none is."""
    speeds = sorted(seen)
    spare = max(1, int(STRAYS * sum(seen.values())))
    anchor, tried = _anchor(speeds, seen, spare), 0
    slope = ROUNDING / anchor
    for part in range(1, int(anchor / FINEST) + 1):
        quantum, strays = anchor / part, 0
        for speed in speeds:
            tried += 1
            off = abs(speed - quantum * round(speed / quantum))
            # The anchor is rounded too, and speeds are off by their share of that.
            if off > ROUNDING + slope * speed:
                strays += seen[speed]
                if strays > spare:
                    break
        else:
            yield
            found = _fitted(seen, quantum, spare, part)
            if found is not None:
                return found
        if tried >= TRIALS:
            tried = 0
            yield
    return None


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
