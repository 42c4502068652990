"""Detects whether the board reports by its own clock or answers the daemon's lines.

While the daemon sends one line per period, both look alike. Sometimes it sends more or fewer lines:
the host stood still, or a command's line went at once. Then the number of lines received follows
either the periods that passed or the lines that left. The decision compares both sums with the
lines received, over the reads in which they differ and over the next few, which bring the lines
that an adapter still held.
"""

from __future__ import annotations

APART = 1.5
"""Difference between periods and lines sent since the last read that scheduling does not cause."""

TELLING = 2.5
"""Difference between the two sums that is needed for a decision."""

LATEST = 100.0
"""Periods since the last read. After more, the read is ignored."""

CLEAR = 0.5
"""Share of the sums' difference by which one sum must be nearer to the received lines."""

AFTER = 3
"""Number of reads after a differing one that belong to it."""

NEAR = 0.35
"""Largest distance of the nearer sum from the received lines, as a share of these: lines are lost
too."""


class ReplyStyle:
    """A comparison of the received lines with the periods and with the lines sent."""

    def __init__(self, speaks: bool) -> None:
        """Start. With `speaks` the configuration says that the board reports by its own clock."""
        self.speaks: bool | None = speaks or None
        """True if the board reports by its own clock, False if it answers, None while unknown."""
        self._known = speaks
        self._left = self._after = 0
        self._came = self._periods = self._asked = 0.0

    def left(self) -> None:
        """Note that a command line left."""
        self._left += 1

    def read(self, lines: int, periods: float) -> None:
        """Take a read of `lines` lines, `periods` reply periods after the last read."""
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
