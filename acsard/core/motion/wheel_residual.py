"""Compares the front and the rear wheel of one side, which roll over the same floor.

If one wheel turns more than the other, it slips or its encoder is faulty, unless one of these
harmless effects explains the difference:

- The position of each wheel between two encoder counts is unknown. This error does not grow with
  the angle, because the next count corrects it.
- The wheels differ, for example in the pressure of their tires. This difference is a constant
  fraction of the angle, so it is learned.
- One motor reacts later than the other.
- The speeds in a feedback line have two decimals.

The comparison uses sums of the angles that the wheels rolled recently. Older angles have less
weight (`TIME_CONSTANT_S`). The wheels contradict each other if

    |D - r A| > ALLOWED_FRACTION B + ALLOWED_COUNTS c + ALLOWED_ANGLE

- D is the sum of the front wheel's angles minus the sum of the rear wheel's angles, rad.
- A is the sum over the lines of the mean angle of both wheels, rad.
- B is the sum over the lines of the mean magnitude of both angles, rad.
- r is the learned fraction.
- c is the angle of an encoder count, rad.

The wheels slip if |D - r A| exceeds this limit by more than ALLOWED_DELAY_S |v - mean of v|, where
v is the speed of the side, rad/s.
"""

from __future__ import annotations

import math

# Without slip, the angles of two wheels can differ by two counts. Therefore a slip by the fraction
# s at v rad/s is certain only after 2 c / (s v) seconds. With 96 counts per revolution, a slip of a
# tenth at 10 rad/s is certain after 0.13 s, or after 0.26 s if unequal tires may cause the
# difference ALLOWED_FRACTION. With the limit ALLOWED_COUNTS, and with sums that forget old angles,
# a slip of a tenth is found within 0.2 s at speeds above 22 rad/s, and is never found at speeds
# below 11.5 rad/s.

TIME_CONSTANT_S = 0.14
"""Time after which the weight of an angle in the sums has fallen to 1 / e, s."""

ALLOWED_FRACTION = 0.05
"""Allowed difference of the angles of the two wheels, as a fraction of their mean angle. It is half
of the slip of 10 % that must be found."""

ALLOWED_COUNTS = 1.2
"""Allowed difference of the angles of the two wheels, in encoder counts. Wheels without slip rarely
differ by more."""

ALLOWED_DELAY_S = 0.03
"""Allowed delay of one motor of a side relative to the other motor, s."""

ALLOWED_ANGLE = 0.002
"""Allowed difference of the angles of the two wheels, rad, in addition to `ALLOWED_FRACTION` and
`ALLOWED_COUNTS`. Backlash and the rounding of speeds to two decimals cause it."""

MAX_LASTING_DIFFERENCE = 0.05
"""Largest fraction by which two healthy wheels of a side may differ permanently."""

LEARNING_S, DOUBTED_S = 5.0, 20.0
"""Times that determine how fast the difference of the two wheels is learned, s. While the wheels
agree, the fraction by which they differ is learned with the time constant `LEARNING_S`. While the
wheels contradict each other, the learned fraction changes by `LEARNING_STEP` in `DOUBTED_S`."""

MIN_LEARNING_SPEED = 1.0
"""Wheel speed below which the difference of the two wheels is not learned, rad/s."""

LEARNING_STEP = 0.1
"""Change of the learned fraction if the wheels contradict each other for `DOUBTED_S`. Slip ends
sooner, but a flat tire stays flat, so its effect is learned."""


class Residual:
    """Compares the two wheels of one side, and learns the fraction by which their angles differ."""

    def __init__(self) -> None:
        self.ratio = 0.0
        """Learned fraction by which the front wheel turns further than the rear one."""
        self.learns = True
        self.slips = False
        """Whether the wheels differ by more than a motor that reacts late can cause. The value is
        valid only if the last call of `add` returned False."""
        self._off = self._way = self._net = 0.0

    def add(self, front: float, rear: float, keep: float, dt: float, count: float) -> bool:
        """Add the motion of a feedback line from the board, and return whether both wheels agree.

        The method also learns the fraction by which the wheels differ, while `learns` is true.

        Args:
            front: the angle that the front wheel rolled since the previous feedback line, rad.
            rear: the angle that the rear wheel rolled since the previous feedback line, rad.
            keep: the factor, from 0 to 1, with which the sums of the angles are multiplied after
                this line was added, so that older angles have less weight (`TIME_CONSTANT_S`).
            dt: the time in which the wheels rolled these angles, s.
            count: the angle of one encoder count, rad.
        """
        mean = (front + rear) / 2
        size = abs(mean) if front * rear >= 0.0 else (abs(front) + abs(rear)) / 2
        off = front - rear - self.ratio * mean
        total = self._off = keep * (self._off + off)
        way = self._way = keep * (self._way + size)
        self._net = keep * (self._net + mean)
        most = ALLOWED_FRACTION * way + ALLOWED_COUNTS * count + ALLOWED_ANGLE
        if abs(total) > most:
            # While the speed changes, a motor that reacts later causes a further difference.
            late = ALLOWED_DELAY_S * abs(mean / dt - self._net / TIME_CONSTANT_S)
            self.slips = abs(total) > most + late
            self._learn(math.copysign(LEARNING_STEP, off * mean) * dt / DOUBTED_S)
            return False
        if abs(mean) > MIN_LEARNING_SPEED * dt:
            self._learn(off / mean * dt / LEARNING_S)
        return True

    def stand_in(self, front: bool) -> float:
        """Return the factor for replacing the angle of one wheel by the angle of the other wheel.

        If `front` is true, the front wheel's angle is the rear wheel's angle times the result.
        Otherwise, the rear wheel's angle is the front wheel's angle times the result.
        """
        more = 1.0 + self.ratio / 2, 1.0 - self.ratio / 2
        return more[0] / more[1] if front else more[1] / more[0]

    @property
    def rolling(self) -> bool:
        """Whether the wheels recently rolled faster than `MIN_LEARNING_SPEED` on average.

        Slower wheels do not show reliably whether they differ.
        """
        return self._way > MIN_LEARNING_SPEED * TIME_CONSTANT_S

    def _learn(self, more: float) -> None:
        if self.learns:
            ratio = self.ratio + more
            self.ratio = (
                ratio
                if abs(ratio) <= MAX_LASTING_DIFFERENCE
                else math.copysign(MAX_LASTING_DIFFERENCE, ratio)
            )
