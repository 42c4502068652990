"""The promise of the jerk limit, judged from the lines alone.

While a speed grows, its acceleration may grow only slowly. Speeds in lines are rounded to 0.01
rad/s, so three lines do not determine a change of the acceleration. `Slope` therefore stores the
highest speed and acceleration that are possible since the last braking.
"""

from __future__ import annotations

STEP = 0.01
"""Step of the speeds on the wire, rad/s."""


class Slope:
    """Upper bounds on the speed and the acceleration of one axis in one direction."""

    def __init__(self) -> None:
        self._seen = self._high = 0.0
        """The speed of the last line, and the highest that it can have been before rounding."""
        self._slope = 0.0

    def take(
        self, speed: float, seconds: float, jerk: float, acceleration: float, room: float
    ) -> bool:
        """Add the speed of a line. Return whether the jerk limit allows it.

        Args:
            speed: The new speed.
            seconds: Time since the previous line, s.
            jerk: The jerk limit.
            acceleration: The acceleration limit.
            room: The largest possible rounding error of the speed.
        """
        before, self._seen = self._seen, speed
        slope = (speed - before + 2 * room) / seconds if seconds > 0.0 else acceleration
        if speed < before or speed <= room:
            self._high, self._slope = speed + room, slope
            return True
        most = min(acceleration, max(self._slope, 0.0) + jerk * seconds)
        high = max(self._high, 0.0) + most * seconds
        self._high, self._slope = min(speed + room, high), min(most, slope)
        return speed - room <= high

    def lose(self, speed: float, room: float, acceleration: float) -> None:
        """Restart at this speed. Its acceleration may be anything up to the limit."""
        self._seen, self._high, self._slope = speed, speed + room, acceleration
