"""Detects an encoder that repeats one speed although its command and the other wheel change.

At a steady speed a stuck encoder reports the same as a sound one. Nothing can detect it then, and
it does not harm the pose. When the command changes, a sound wheel must report another speed, even a
slow wheel once it has gone a few counts further than the old speed would take it. If the other
wheel of the side has followed the command, the command itself was obeyed.
"""

from __future__ import annotations

import math

LIE_S = 0.025
"""Seconds of one repeated speed. A single bad reading is not a fault."""

LEAVES = 0.05
"""rad/s by which a command must differ from that at the first repetition."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01
"""Counts and rad after which even a slow wheel has left its old speed."""

OTHER_COUNTS, OTHER_ANGLE = 3.5, 0.05
"""Counts and rad by which the other wheel must have left it."""


class Stuck:
    """The test of one wheel, line by line."""

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def left_by(self, command: float) -> bool:
        """Return whether the command, rad/s, differs from that at the first repetition."""
        return abs(command - self._command) >= LEAVES

    def says(
        self, same: bool, apart: float, dt: float, count: float, slow: float, command: float
    ) -> bool:
        """Return whether the encoder is stuck, after a line of `dt` s.

        Args:
            same: Whether the wheel turns and repeats the speed of the line before.
            apart: Angle that the other wheel turned more in the line, rad.
            dt: Duration of the line, s.
            count: Angle of an encoder count, rad.
            slow: Speed of a wheel that follows its command slowly, rad/s.
            command: Speed of a wheel that follows at once, rad/s.
        """
        leaves = command - self._command
        if not (same and abs(leaves) >= LEAVES):  # this also holds for the first line
            self._begin(slow, command)
            return False
        self._seconds += dt
        self._followed += (slow - self._slow) * dt
        self._other += apart
        followed = self._followed if leaves > 0.0 else -self._followed
        other = self._other if leaves > 0.0 else -self._other
        return (
            self._seconds >= LIE_S
            and followed >= FOLLOWED_COUNTS * count + FOLLOWED_ANGLE
            and other >= OTHER_COUNTS * count + OTHER_ANGLE
        )
