"""How far a wheel's reports step from line to line: what its encoder's counts make of its speed.

One count more or less in a period is a step of 2 pi / (counts T), 31 rad/s at 20 counts a turn and
100 Hz, and no acceleration. How large these steps are is learned from the reports themselves, of
any firmware: counts by its nominal period, by the time measured, or filtered. Steps so large must
recur, and do where they are counts; a damaged line makes two, one there and one back.
"""

from __future__ import annotations

import math

FLICKER = 0.0105
"""rad/s; no more than rounding."""

BLOCK = 64
"""Steps that are looked at together: with a filter behind few counts, three counts' worth."""

FIRST = 24
"""Steps of a first block after which it says something: its own largest, which may still grow."""

RECUR = 3
"""The largest step counts that so many of a block reach: one damaged line makes two."""


class Steps:
    """Those of one wheel; `size` of them in rad/s, `math.inf` until enough of them were seen."""

    def __init__(self) -> None:
        self.size = math.inf
        self._before = math.inf
        self._last = 0.0
        self._largest = [0.0] * RECUR
        self._count = 0

    def add(self, speed: float) -> None:
        """The next report, rad/s."""
        step = abs(speed - self._last)
        if step < FLICKER:
            return
        self._last = speed
        largest = self._largest
        if step > largest[0]:
            largest[0] = step
            largest.sort()
            if largest[0] > self.size:
                self.size = largest[0]
        self._count += 1
        if self._count == FIRST and self.size == math.inf:
            self.size = largest[0]
        if self._count == BLOCK:
            # A block's own and the one before it: at its start it has seen too little.
            self._before, self._count = largest[0], 0
            self.size, self._largest = self._before, [0.0] * RECUR
