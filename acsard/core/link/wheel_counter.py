"""Learns the counts per turn of one wheel's encoder from its reported speeds.

It learns from changes of the speed, because a steady speed repeats one value. When the counts are
known, each speed is an angle of whole counts, without a rounding error. The error until then is
corrected afterwards, from the number of times that each speed was reported.
"""

from __future__ import annotations

import math

from acsard.core.link.encoder_steps import FLICKER, Steps
from acsard.core.link.quantization_step import FINEST, ROUNDING, Quantization, Search, on

LEARNED_FROM = 100
"""Changes of a wheel's speed before a lattice is searched."""

MOST_SEEN = 256
"""Different speeds remembered, which bounds a search."""

MOST_TOLD = 512
"""Different speeds whose rounding is corrected later: as many as 10 000 counts a turn make."""

OWED_FOR = 3000
"""Lines after which the owed correction is dropped, because it belongs to another place."""

LONGEST_WAIT = 128 * LEARNED_FROM
"""Largest number of changes between two searches of speeds without a lattice: minutes of
driving."""


class WheelCounter:
    """The encoder of one wheel; `counts` per turn, 0 until they are known."""

    def __init__(self) -> None:
        self.counts = self.off = 0
        self.quantum = self.angle = 0.0
        """One count in a period, as a speed in rad/s and as an angle in rad."""
        self.steps = Steps()
        self.lattice: Quantization | None = None
        self._search: Search | None = None
        self._told: dict[float, int] | None = {}
        """How often each speed was reported before the counts were known, forward minus backward.
        None if there were too many different speeds."""
        self._owing = 0
        """Number of lines in `_told`."""
        self._last = 0.0
        self._seen: dict[float, int] = {}
        self._missing = self._patience = LEARNED_FROM
        """Changes until the next search, and changes to the one after it."""

    def learn(self, speed: float) -> None:
        """Take the next report of a wheel whose counts are unknown."""
        self._owing += 1
        if self._owing > OWED_FOR:
            self.forgive()
        if speed and self._told is not None:
            size, way = abs(speed), 1 if speed > 0 else -1
            self._told[size] = self._told.get(size, 0) + way
            if len(self._told) > MOST_TOLD:
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
        """Continue the search, if one runs; return whether it has just found a lattice."""
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
        """Return the angle that the wheel turned in the `own` s of this line, rad.

        The result includes `missing` s of lines that were lost before it.
        """
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
        """Return the rounding error until the counts were known, rad. Call it once."""
        told, self._told = self._told or {}, None
        return math.fsum(
            times * (round(speed / self.quantum) * self.angle - speed * period)
            for speed, times in told.items()
            if on(speed, self.quantum)
        )

    def forgive(self) -> None:
        """Drop the correction for everything until now."""
        self._owing = 0
        if self._told is not None:
            self._told = None if self.counts else {}

    def show(self, period: float) -> bool:
        """Return whether `period` s, as the firmware's divisor, makes the counts per turn whole.

        If it does, adopt these counts.
        """
        counts = self.lattice.counts(period) if self.lattice and not self.counts else 0
        if counts:
            self.counts, self.angle = counts, math.tau / counts
            self.quantum = self.angle / period
            self.lattice = Quantization(self.quantum, 0.0)
            self._search, self.off = None, 0
        return self.counts > 0
