"""How well a straight line between two known speeds tells what the robot did in between.

It is off by s_a t2 / 2 after t s without lines, along and turning, with s_a what the acceleration
deviates by. The limits bound that, but few drives stay at them. So s_a is measured where there are
lines: how far the way of every fifth of a second was off the one that its first and its last speed
would have made. The robot changes its acceleration at any time, so that s_a2 itself grows with t.
It is never off by more than all of the faster speed: who stood before and after has been nowhere.
"""

from __future__ import annotations

from acsard.values import REST, Twist

GUESS = Twist(0.125, 0.5)
"""m/s2 and rad/s2; s_a over `SPAN` before anything is measured: an eighth of the default limits,
which random driving at them hardly reaches."""

SPAN = 0.2
"""s over which the deviation is measured."""

FIRST, MOST = 4.0, 300.0
"""Spans that the guess counts for, and that are remembered: a minute of driving."""

GROWTH = 5
"""The power of time by which the variance grows: 4 of s_a2 t4 / 4, and 1 of s_a2."""


class Gaps:
    """Measures s_a while lines come; tells the variances of the way while none did."""

    def __init__(self) -> None:
        self._along = (GUESS.linear * SPAN**2 / 2) ** 2
        self._turning = (GUESS.angular * SPAN**2 / 2) ** 2
        self._spans = FIRST
        self.interrupt(REST)

    def interrupt(self, twist: Twist) -> None:
        """What comes now begins with `twist`, and is not measured with what came before."""
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0
        self._bridged, self._given = 0.0, (0.0, 0.0)

    def follow(self, twist: Twist, dt: float) -> None:
        """A line said that the last `dt` s were driven with `twist`."""
        linear, angular = twist.linear, twist.angular
        self._bridged, self._given = 0.0, (0.0, 0.0)
        self._seconds += dt
        self._distance += linear * dt
        self._turn += angular * dt
        span = self._seconds - dt  # between the two lines that are taken to be known
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
        """m2 along and rad2 for more of one gap, `seconds` long, that a line was drawn across.

        A gap may come in pieces, one behind the other: it counts as a whole.
        """
        bridged, given = self._bridged + seconds, self._given
        along, yaw = self.unseen(bridged, before, after)
        self.interrupt(after)
        self._bridged, self._given = bridged, (max(along, given[0]), max(yaw, given[1]))
        return max(0.0, along - given[0]), max(0.0, yaw - given[1])

    def unseen(self, seconds: float, before: Twist, after: Twist) -> tuple[float, float]:
        """m2 along and rad2 by which `seconds` between two known twists may deviate."""
        scale = (seconds / SPAN) ** GROWTH
        fastest = max(abs(before.linear), abs(after.linear)) * seconds
        turning = max(abs(before.angular), abs(after.angular)) * seconds
        return min(self._along * scale, fastest**2), min(self._turning * scale, turning**2)
