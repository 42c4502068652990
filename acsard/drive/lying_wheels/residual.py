"""Front and rear wheel of one side compared: two witnesses of the same way.

Both roll over the same floor, so what one turns more than the other is slip, a lie, or one of four
things that are neither: the count each of them may stand beside, wheels that differ (a tyre, its
load), motors of which one follows sooner, and the line's two decimals. The counts' share does not
grow with the way, since what a count says too much the next one takes back. The wheels' share
stays the same, so it is learned. So sums that forget are compared, angles and no speeds:

    |off - r way| > SHARE way + COUNTS count + LEAST (+ LAG_S |speed - its mean|)

with off the sum of front - rear, way that of the side's turning and r what is learned. Lags make a
slip of it only beyond the last term; a wheel is suspected before.

Two wheels of which nobody knows where in a count they stand differ by up to two counts without any
slip, so one of s at w rad/s cannot be told for certain before 2 count / (s w): a tenth at 10 rad/s
takes 0.13 s with 96 counts a turn, and 0.26 s where SHARE is left to tyres. With COUNTS, and sums
that forget, it is told within 0.2 s above 22 rad/s, and below 11.5 rad/s not at all.
"""

from __future__ import annotations

import math

MEMORY_S = 0.14
"""s; after these a sum remembers the 1 / e of what it was."""

SHARE = 0.05
"""Of the way: half of the slip of 10 % that is to be found."""

COUNTS = 1.2
"""Counts; two wheels that stand anywhere within one are seldom further apart."""

LAG_S = 0.03
"""s by which one motor may follow its command later than the other."""

LEAST = 0.002
"""rad; two decimals, and play."""

UNEQUAL = 0.05
"""Share by which two healthy wheels of a side may turn differently for good."""

LEARNING_S, DOUBTED_S = 5.0, 20.0
"""s of driving in which that is learned, and that it takes where they contradict each other."""

SLOWEST = 1.0
"""rad/s; slower wheels tell nothing of their size."""

WILD = 0.1
"""Share that a line which contradicts counts as at most: a slip soon ends, a tyre does not."""


class Residual:
    """The sums of one side."""

    def __init__(self) -> None:
        self.ratio = 0.0
        """By which share the front wheel turns more than the rear one, as long as all is well."""
        self.learns = True
        self.slips = False
        """They differ by more than motors of which one is later, where they do."""
        self._off = self._way = self._net = 0.0

    def add(self, front: float, rear: float, keep: float, dt: float, count: float) -> bool:
        """A line of `dt` s, rad each; False when they contradict each other.

        `keep` is what is left of the sums after it, `count` the angle of an encoder's count.
        """
        mean = (front + rear) / 2
        size = abs(mean) if front * rear >= 0.0 else (abs(front) + abs(rear)) / 2
        off = front - rear - self.ratio * mean
        total = self._off = keep * (self._off + off)
        way = self._way = keep * (self._way + size)
        self._net = keep * (self._net + mean)
        most = SHARE * way + COUNTS * count + LEAST
        if abs(total) > most:
            # One motor may be later than the other while the speed changes.
            late = LAG_S * abs(mean / dt - self._net / MEMORY_S)
            self.slips = abs(total) > most + late
            self._learn(math.copysign(WILD, off * mean) * dt / DOUBTED_S)
            return False
        if abs(mean) > SLOWEST * dt:
            self._learn(off / mean * dt / LEARNING_S)
        return True

    def stand_in(self, front: bool) -> float:
        """The front wheel's turn per turn of the rear one, or the other way round."""
        more = 1.0 + self.ratio / 2, 1.0 - self.ratio / 2
        return more[0] / more[1] if front else more[1] / more[0]

    @property
    def rolling(self) -> bool:
        """It rolls so fast that wheels which agree do agree."""
        return self._way > SLOWEST * MEMORY_S

    def _learn(self, more: float) -> None:
        if self.learns:
            ratio = self.ratio + more
            self.ratio = ratio if abs(ratio) <= UNEQUAL else math.copysign(UNEQUAL, ratio)
