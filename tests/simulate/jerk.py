"""The promise of jerk, judged by the lines alone: while a speed grows, so does its slope, slowly.

A line has speeds in steps of 0.01 rad/s, so two accelerations from three lines say little. `Slope`
therefore keeps the highest speed and slope that all lines since the last braking allow.
"""

from __future__ import annotations

STEP = 0.01
"""Step of the speeds on the wire, rad/s."""


class Slope:
    """Bounds on the speed of one axis in one direction, and on its slope."""

    def __init__(self) -> None:
        self._seen = self._high = 0.0
        """The speed of the last line, and the highest that it can have been before rounding."""
        self._slope = 0.0

    def take(
        self, speed: float, seconds: float, jerk: float, acceleration: float, room: float
    ) -> bool:
        """Take the speed of a line and return whether the jerk allows it.

        `room` is the most that rounding can have changed. The line is `seconds` behind the last.
        """
        before, self._seen = self._seen, speed
        seen = (speed - before + 2 * room) / seconds if seconds > 0.0 else acceleration
        if speed < before or speed <= room:
            self._high, self._slope = speed + room, seen
            return True
        most = min(acceleration, max(self._slope, 0.0) + jerk * seconds)
        high = max(self._high, 0.0) + most * seconds
        self._high, self._slope = min(speed + room, high), min(most, seen)
        return speed - room <= high

    def lose(self, speed: float, room: float, acceleration: float) -> None:
        """Start over from this speed, with any slope."""
        self._seen, self._high, self._slope = speed, speed + room, acceleration
