"""A wheel that says one and the same speed while its command and the other wheel go elsewhere.

At a steady speed a stuck encoder says what a sound one does: nothing can tell it, and nothing need,
for it costs the pose nothing. Once the command leaves, a wheel that turns by it has to say another
speed: even one that follows slowly, as soon as it has gone a few counts further than the old
speed makes it. Where the other one has gone that way, it is not the command that was not obeyed.
"""

from __future__ import annotations

import math

LIE_S = 0.025
"""s of one and the same; one spoilt reading is no lie."""

LEAVES = 0.05
"""rad/s by which a command differs from the one at which the wheel began to say the same."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01
"""Counts and rad by which even a slow wheel has left its old speed."""

OTHER_COUNTS, OTHER_ANGLE = 3.5, 0.05
"""Counts and rad by which the other wheel has."""


class Stuck:
    """One wheel, line after line."""

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def left_by(self, command: float) -> bool:
        """The command, rad/s, is another one than that at which it began to say the same."""
        return abs(command - self._command) >= LEAVES

    def says(
        self, same: bool, apart: float, dt: float, count: float, slow: float, command: float
    ) -> bool:
        """Whether it is, after a line of `dt` s in which the other wheel turned `apart` rad more.

        `same` if it says the very speed of the line before, and turns. The rad/s of a wheel that
        follows its command slowly, and of one that does at once; `count` rad is an encoder's count.
        """
        leaves = command - self._command
        if not (same and abs(leaves) >= LEAVES):  # nor of a first line
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
