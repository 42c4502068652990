"""One wheel's encoder as its reported speeds show it: counts a turn, and how it makes them step.

Learns from changes of the speed, for a steady one says the same again and again. Once the counts
are known each speed is an angle of whole counts, without rounding; and what rounding has cost until
then is made good, since of each speed it is known how often it was told.
"""

from __future__ import annotations

import math

from acsard.mcu.lattice import FINEST, ROUNDING, Lattice, Search, on
from acsard.mcu.steps import FLICKER, Steps

LEARNED_FROM = 100
"""Changes of a wheel's speed after which a lattice is looked for."""

MOST_SEEN = 256
"""Different speeds remembered: what bounds a search."""

MOST_TOLD = 512
"""Different speeds whose rounding is made good later: those of 10 000 counts a turn."""

OWED_FOR = 3000
"""Lines whose rounding is made good; what was owed before these belongs to another place."""

LONGEST_WAIT = 128 * LEARNED_FROM
"""Changes until a stream without a lattice is looked at again: minutes of driving."""


class WheelCounter:
    """One wheel: `counts` a turn of its encoder once they are known, else 0."""

    def __init__(self) -> None:
        self.counts = self.off = 0
        self.quantum = self.angle = 0.0
        """rad/s and rad, of one count in a period."""
        self.steps = Steps()
        self.lattice: Lattice | None = None
        self._search: Search | None = None
        self._told: dict[float, int] | None = {}
        """How often each speed was told before the counts were known, forward less backward;"""
        self._owing = 0
        """in so many lines."""
        self._last = 0.0
        self._seen: dict[float, int] = {}
        self._missing = self._patience = LEARNED_FROM
        """Changes until it is searched, and how many more if that does not help."""

    def learn(self, speed: float) -> None:
        """The next report of a wheel whose counts are unknown."""
        self._owing += 1
        if self._owing > OWED_FOR:
            self.forgive()
        told = self._told
        if speed and told is not None:
            size, way = (speed, 1) if speed > 0 else (-speed, -1)
            told[size] = told.get(size, 0) + way
            if len(told) > MOST_TOLD:
                self._told = None
        if self._search is None and abs(speed - self._last) >= FLICKER:
            self._last, size = speed, abs(speed)
            self._missing -= 1
            fresh = self._missing < LEARNED_FROM or self.lattice is not None
            room = size in self._seen or len(self._seen) < MOST_SEEN
            if fresh and room and size >= FINEST:
                self._seen[size] = self._seen.get(size, 0) + 1
            if self._missing <= 0 and self._seen:
                self._search = Search(self._seen)

    def go_on(self) -> bool:
        """Search a little further, if it does; whether it has just found a lattice."""
        if self._search is None:
            return False
        if not self._search.go_on():
            return False
        self.lattice, self._search = self._search.found, None
        if self.lattice is None:
            self._seen = {}
        self._missing = self._patience
        self._patience = min(2 * self._patience, LONGEST_WAIT)
        return self.lattice is not None

    def turned(self, speed: float, own: float, missing: float) -> float:
        """rad in the `own` s of this line; `missing` s more went by that no line reported."""
        if not self.counts:
            self.steps.add(speed)
            self.learn(speed)
            return speed * own
        whole = round(speed / self.quantum)
        if abs(speed - whole * self.quantum) > ROUNDING:
            self.off += 1
            return speed * own
        return whole * self.angle + speed * missing

    def owed(self, period: float) -> float:
        """rad that rounding has cost while the counts were unknown; asked for once."""
        told, self._told = self._told or {}, None
        return math.fsum(
            times * (round(speed / self.quantum) * self.angle - speed * period)
            for speed, times in told.items()
            if on(speed, self.quantum)
        )

    def forgive(self) -> None:
        """Nothing is owed for what was until now."""
        self._owing = 0
        if self._told is not None:
            self._told = None if self.counts else {}

    def show(self, period: float) -> bool:
        """Whether it shows how many counts a turn it has, if its firmware divides by `period` s."""
        counts = self.lattice.counts(period) if self.lattice and not self.counts else 0
        if counts:
            self.counts, self.angle = counts, math.tau / counts
            self.quantum = self.angle / period
            self.lattice = Lattice(self.quantum, 0.0)
            self._search, self.off = None, 0
        return self.counts > 0
