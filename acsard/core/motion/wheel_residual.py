"""Compares the front and the rear wheel of one side, which roll over the same floor.

A difference is slip or a faulty encoder, unless it is harmless: each position between two counts is
unknown, tires differ (a constant fraction, which is learned), a motor reacts late, or speeds are
rounded. The sums of recent angles (`TIME_CONSTANT_S`) contradict each other if |D - r A| >
ALLOWED_FRACTION B + ALLOWED_COUNTS c + ALLOWED_ANGLE: D is front minus rear, A the mean, B the mean
magnitude, r the learned fraction, c the angle of a count. The wheels slip if the excess is over
ALLOWED_DELAY_S |v - mean of v|, with the side's speed v, rad/s.
"""

from __future__ import annotations

import math

# Wheels without slip can differ by two counts, so a slip by the fraction s at v rad/s is certain
# after 2 c / (s v) seconds: with 96 counts, a tenth at 10 rad/s after 0.13 s, or after 0.26 s if
# unequal tires may cause ALLOWED_FRACTION. With ALLOWED_COUNTS and these sums, a slip of a tenth is
# found within 0.2 s above 22 rad/s, and never below 11.5 rad/s.

TIME_CONSTANT_S = 0.14  # after which an angle has the weight 1 / e

ALLOWED_FRACTION = 0.05  # of the mean angle: half of the slip of 10 % that must be found

ALLOWED_COUNTS = 1.2  # counts: wheels without slip rarely differ by more

ALLOWED_DELAY_S = 0.03  # of one motor of a side to the other

ALLOWED_ANGLE = 0.002  # rad, by backlash and the rounding of speeds

MAX_LASTING_DIFFERENCE = 0.05  # fraction by which healthy wheels may differ for good

# Time constant of the fraction while the wheels agree, and time for `LEARNING_STEP` while not.
LEARNING_S, DOUBTED_S = 5.0, 20.0

MIN_LEARNING_SPEED = 1.0  # rad/s

LEARNING_STEP = 0.1  # slip ends sooner than `DOUBTED_S`, but a flat tire stays flat and is learned


class Residual:
    """Compares the two wheels of one side, and learns the fraction by which their angles differ."""

    def __init__(self) -> None:
        self.ratio = 0.0  # learned, by which the front wheel turns further
        self.learns = True
        self.slips = False  # more than a late motor can cause, if the last `add` returned False
        self._off = self._way = self._net = 0.0

    def add(self, front: float, rear: float, keep: float, dt: float, count: float) -> bool:
        """Add a line, and return whether both wheels agree; learn the fraction while `learns`.

        `front` and `rear` are angles since the last line, rad, and `keep` is the factor, 0 to 1,
        for the sums after it.
        """
        mean = (front + rear) / 2
        size = abs(mean) if front * rear >= 0.0 else (abs(front) + abs(rear)) / 2
        off = front - rear - self.ratio * mean
        total = self._off = keep * (self._off + off)
        way = self._way = keep * (self._way + size)
        self._net = keep * (self._net + mean)
        most = ALLOWED_FRACTION * way + ALLOWED_COUNTS * count + ALLOWED_ANGLE
        if abs(total) > most:
            # A motor that reacts later causes a further difference.
            late = ALLOWED_DELAY_S * abs(mean / dt - self._net / TIME_CONSTANT_S)
            self.slips = abs(total) > most + late
            self._learn(math.copysign(LEARNING_STEP, off * mean) * dt / DOUBTED_S)
            return False
        if abs(mean) > MIN_LEARNING_SPEED * dt:
            self._learn(off / mean * dt / LEARNING_S)
        return True

    def stand_in(self, front: bool) -> float:
        """Return the factor from the other wheel's angle to the front (or rear) wheel's."""
        more = 1.0 + self.ratio / 2, 1.0 - self.ratio / 2
        return more[0] / more[1] if front else more[1] / more[0]

    @property
    def rolling(self) -> bool:
        """Whether the wheels rolled fast enough on average to show whether they differ."""
        return self._way > MIN_LEARNING_SPEED * TIME_CONSTANT_S

    def _learn(self, more: float) -> None:
        if self.learns:
            ratio = self.ratio + more
            self.ratio = (
                ratio
                if abs(ratio) <= MAX_LASTING_DIFFERENCE
                else math.copysign(MAX_LASTING_DIFFERENCE, ratio)
            )
