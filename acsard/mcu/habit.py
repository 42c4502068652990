"""Does the MCU report by its own clock, or does it answer our lines? Seen when the two differ.

While we send a line every period, both look alike. When we send more or fewer (the host stood
still, a command's line went at once) the lines that come are as many as periods have passed or as
lines have left: whichever it is, it is told by the sums over the reads in which they differ, and
the few after them, which bring what an adapter still held.
"""

from __future__ import annotations

APART = 1.5
"""Periods and lines that left since the last read: more apart than what a scheduler does."""

TELLING = 2.5
"""How far apart the two sums must be to tell."""

LATEST = 100.0
"""Periods since the last read; after more, nothing is expected of anybody."""

CLEAR = 0.5
"""By which share of what the sums are apart one must be nearer to what came than the other."""

AFTER = 3
"""Reads after one in which they differ that belong to it."""

NEAR = 0.35
"""How far from what came the better one may be, as a share of it: lines are lost too."""


class Habit:
    """Compares what comes with both clocks, read by read."""

    def __init__(self, speaks: bool) -> None:
        """`speaks` when it is configured to report by its own clock; else that shows."""
        self.speaks: bool | None = speaks or None
        """It reports by its own clock, it answers; None while nobody can tell."""
        self._known = speaks
        self._left = self._after = 0
        self._came = self._periods = self._asked = 0.0

    def left(self) -> None:
        """A line of ours has left."""
        self._left += 1

    def read(self, lines: int, periods: float) -> None:
        """So many lines came, so many of its periods after the last read."""
        left, self._left = self._left, 0
        if self._known or periods > LATEST:
            return
        if abs(periods - left) >= APART:
            self._after = AFTER
        elif self._after:
            self._after -= 1
        else:
            return
        self._came += lines
        self._periods += periods
        self._asked += left
        came, own, asked = (
            self._came,
            abs(self._came - self._periods),
            abs(self._came - self._asked),
        )
        apart = abs(self._periods - self._asked)
        if apart < TELLING or abs(own - asked) < CLEAR * apart:
            return
        if min(own, asked) <= max(1.5, NEAR * came):
            self.speaks = own < asked
        self._came = self._periods = self._asked = 0.0
        self._after = 0
