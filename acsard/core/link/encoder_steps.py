"""Learns how far a wheel's reported speed steps from line to line because of its encoder.

One count more or less in a period is a step of 2 pi / (counts T): 31 rad/s at 20 counts a turn and
100 Hz. It is not an acceleration. The size of these steps is learned from the reports themselves.
That works for any firmware, whether it divides counts by its nominal period or by the measured
time, or filters them. Steps that come from counts recur. A damaged line makes only two, one there
and one back.
"""

from __future__ import annotations

import math

FLICKER = 0.0105
"""rad/s. A smaller step is only rounding."""

BLOCK = 64
"""Steps that are examined together: enough for three counts even if a filter smooths few counts."""

FIRST = 24
"""Steps of the first block after which `size` has a first value, which may still grow."""

RECUR = 3
"""Number of steps of a block that must reach a size. One damaged line makes two."""


class Steps:
    """The step of one wheel's speed.

    `size` is in rad/s, `math.inf` until enough steps were seen.
    """

    def __init__(self) -> None:
        self.size = math.inf
        self._before = math.inf
        self._last = 0.0
        self._largest = [0.0] * RECUR
        self._count = 0

    def add(self, speed: float) -> None:
        """Take the next reported speed, rad/s."""
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
            # At its start a block has seen too little, so the size of the block before still
            # counts.
            self._before, self._count = largest[0], 0
            self.size, self._largest = self._before, [0.0] * RECUR
