"""Does the MCU report by its own clock, or does it answer our lines? Seen when the two differ.

While we send a line every period, both look alike. When we send more or fewer (the host stood
still, a command's line went at once) the lines that come are as many as periods have passed or as
lines have left: whichever it is, it is told by the sums over the reads in which they differ.
"""

from __future__ import annotations

APART = 1.5
"""Periods and lines that left since the last read: more apart than what a scheduler does."""

TELLING = 2.5
"""How far apart the two sums must be to tell."""

LATEST = 100.0
"""Periods since the last read; after more, nothing is expected of anybody."""

NEAR = 0.35
"""How far from what came the better one may be, as a share of it: lines are lost too."""


class Habit:
    """Compares what comes with both clocks, read by read."""

    def __init__(self, speaks: bool) -> None:
        """`speaks` when it is configured to report by its own clock; else that shows."""
        self.speaks: bool | None = speaks or None
        """It reports by its own clock, it answers; None while nobody can tell."""
        self._known = speaks
        self._left = 0
        self._came = self._periods = self._asked = 0.0

    def left(self) -> None:
        """A line of ours has left."""
        self._left += 1

    def read(self, lines: int, periods: float) -> None:
        """So many lines came, so many of its periods after the last read."""
        left, self._left = self._left, 0
        if self._known or abs(periods - left) < APART or periods > LATEST:
            return
        self._came += lines
        self._periods += periods
        self._asked += left
        came, own, asked = (
            self._came,
            abs(self._came - self._periods),
            abs(self._came - self._asked),
        )
        if abs(self._periods - self._asked) < TELLING:
            return
        if min(own, asked) <= max(1.5, NEAR * came):
            self.speaks = own < asked
        self._came = self._periods = self._asked = 0.0
