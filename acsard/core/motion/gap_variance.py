"""Estimates how far the motion in a gap deviates from a straight line between two known speeds.

After t s without lines the deviation is s_a t2 / 2, along and turning, where s_a is the standard
deviation of the acceleration. The limits bound s_a, but few drives stay at them. Therefore s_a is
measured while lines come: it compares the way in every fifth of a second with the way that the
first and the last speed would have made. The robot may change its acceleration at any time, so s_a2
itself grows with t. The deviation never exceeds the way at the faster speed: a robot that stood
before and after the gap has not moved.
"""

from __future__ import annotations

from acsard.core.values import REST, Twist

GUESS = Twist(0.125, 0.5)
"""Assumed s_a over `SPAN` before any measurement, m/s2 and rad/s2: an eighth of the default limits,
which random driving at these limits hardly reaches."""

SPAN = 0.2
"""Time over which the deviation is measured, s."""

FIRST, MOST = 4.0, 300.0
"""Number of spans for which the assumption counts, and number that is remembered: a minute of
driving."""

GROWTH = 5
"""Power of the time with which the variance grows: 4 from s_a2 t4 / 4, and 1 from the growth of
s_a2."""


class Gaps:
    """The measured s_a, and the variances of the way in gaps."""

    def __init__(self) -> None:
        self._along = (GUESS.linear * SPAN**2 / 2) ** 2
        self._turning = (GUESS.angular * SPAN**2 / 2) ** 2
        self._spans = FIRST
        self.interrupt(REST)

    def interrupt(self, twist: Twist) -> None:
        """Start a new span with `twist`, independent of the span before."""
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0
        self._bridged, self._given = 0.0, (0.0, 0.0)

    def follow(self, twist: Twist, dt: float) -> None:
        """Take a line that reports `twist` for the last `dt` s."""
        linear, angular = twist.linear, twist.angular
        self._bridged, self._given = 0.0, (0.0, 0.0)
        self._seconds += dt
        self._distance += linear * dt
        self._turn += angular * dt
        span = self._seconds - dt  # the time between the two lines whose speeds are taken as known
        if span < SPAN:
            return
        first = self._first
        if self._distance or self._turn or linear or angular:
            off = self._distance - linear * dt - span * (first.linear + linear) / 2
            turned = self._turn - angular * dt - span * (first.angular + angular) / 2
            scale = (SPAN / span) ** GROWTH
            self._spans = min(self._spans + 1.0, MOST)
            self._along += (off * off * scale - self._along) / self._spans
            self._turning += (turned * turned * scale - self._turning) / self._spans
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0

    def bridge(self, seconds: float, before: Twist, after: Twist) -> tuple[float, float]:
        """Return the variances, m2 along and rad2, that `seconds` more of a filled gap add.

        A gap may come in several consecutive pieces. They count as one gap.
        """
        bridged, given = self._bridged + seconds, self._given
        along, yaw = self.unseen(bridged, before, after)
        self.interrupt(after)
        self._bridged, self._given = bridged, (max(along, given[0]), max(yaw, given[1]))
        return max(0.0, along - given[0]), max(0.0, yaw - given[1])

    def unseen(self, seconds: float, before: Twist, after: Twist) -> tuple[float, float]:
        """Return the variances of `seconds` between two known twists, m2 along and rad2."""
        scale = (seconds / SPAN) ** GROWTH
        fastest = max(abs(before.linear), abs(after.linear)) * seconds
        turning = max(abs(before.angular), abs(after.angular)) * seconds
        return min(self._along * scale, fastest**2), min(self._turning * scale, turning**2)
