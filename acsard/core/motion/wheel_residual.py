"""Compares the front and the rear wheel of one side, which roll over the same floor.

If one wheel turns more than the other, the reason is slip, a faulty encoder, or one of four
harmless effects: the position of each wheel within a count, wheels that differ (a tyre, its load),
motors of which one follows sooner, and the two decimals of the line. The error by counts does not
grow with the way, because the next count takes it back. The wheels' difference is a constant share,
so it is learned. The comparison uses sums of angles, not speeds, and these sums forget:

    |off - r way| > SHARE way + COUNTS count + LEAST (+ LAG_S |speed - its mean|)

where off is the sum of front - rear, way that of the side's turning and r the learned share. For
slip the last term, for the motors' lag, is added. A wheel becomes suspect without it.

Two wheels at unknown positions within a count differ by up to two counts without any slip. A slip
of share s at w rad/s therefore cannot be certain before 2 count / (s w). With 96 counts a turn, a
slip of a tenth at 10 rad/s takes 0.13 s, and 0.26 s if SHARE is left to tyres. With COUNTS and sums
that forget it is found within 0.2 s above 22 rad/s, and never below 11.5 rad/s.
"""

from __future__ import annotations

import math

MEMORY_S = 0.14
"""Time after which a sum has fallen to 1 / e, s."""

SHARE = 0.05
"""Share of the way that may differ: half of the slip of 10 % that must be found."""

COUNTS = 1.2
"""Counts that may differ. Two wheels anywhere within a count are seldom further apart."""

LAG_S = 0.03
"""Lag of one motor behind the other that is allowed, s."""

LEAST = 0.002
"""rad that may differ besides, for the two decimals and for play."""

UNEQUAL = 0.05
"""Share by which two healthy wheels of a side may differ permanently."""

LEARNING_S, DOUBTED_S = 5.0, 20.0
"""Seconds of driving in which that share is learned: normally, and while the wheels contradict each
other."""

SLOWEST = 1.0
"""rad/s. Slower wheels show nothing about their size."""

WILD = 0.1
"""Greatest share that a contradicting line can teach. A slip soon ends, but a tyre stays."""


class Residual:
    """The sums of one side."""

    def __init__(self) -> None:
        self.ratio = 0.0
        """Learned share by which the front wheel turns more than the rear one."""
        self.learns = True
        self.slips = False
        """Whether a contradicting pair differs by more than a lag of one motor explains."""
        self._off = self._way = self._net = 0.0

    def add(self, front: float, rear: float, keep: float, dt: float, count: float) -> bool:
        """Take a line of `dt` s, with the wheels' angles in rad; return whether the wheels agree.

        `keep` is the factor by which the line reduces the sums, and `count` the angle of a count.
        """
        mean = (front + rear) / 2
        size = abs(mean) if front * rear >= 0.0 else (abs(front) + abs(rear)) / 2
        off = front - rear - self.ratio * mean
        total = self._off = keep * (self._off + off)
        way = self._way = keep * (self._way + size)
        self._net = keep * (self._net + mean)
        most = SHARE * way + COUNTS * count + LEAST
        if abs(total) > most:
            # One motor may lag the other while the speed changes.
            late = LAG_S * abs(mean / dt - self._net / MEMORY_S)
            self.slips = abs(total) > most + late
            self._learn(math.copysign(WILD, off * mean) * dt / DOUBTED_S)
            return False
        if abs(mean) > SLOWEST * dt:
            self._learn(off / mean * dt / LEARNING_S)
        return True

    def stand_in(self, front: bool) -> float:
        """Return the ratio of the angles, front to rear, or rear to front if not `front`."""
        more = 1.0 + self.ratio / 2, 1.0 - self.ratio / 2
        return more[0] / more[1] if front else more[1] / more[0]

    @property
    def rolling(self) -> bool:
        """Whether the wheels roll so fast that their agreement means something."""
        return self._way > SLOWEST * MEMORY_S

    def _learn(self, more: float) -> None:
        if self.learns:
            ratio = self.ratio + more
            self.ratio = ratio if abs(ratio) <= UNEQUAL else math.copysign(UNEQUAL, ratio)
