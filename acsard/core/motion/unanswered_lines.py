"""Warns if the board leaves lines of an established link unanswered, which nothing else would show.

The warning comes once, until the link is sound again or lost. A board that reports by a clock of
its own at another rate looks the same and is not faulty.
"""

from __future__ import annotations

from acsard.core.values import Event

WINDOW = 1000
"""Lines sent that are examined together: 10 s at 100 Hz."""

LOST = 0.02
"""Share of lost answers that causes the warning. A sound link loses none."""


class UnansweredLines:
    """A comparison of the totals of lines sent and of good lines, window by window."""

    def __init__(self, reply_period: float) -> None:
        """Start; `reply_period` is that of a board with a clock of its own, s, else 0."""
        self._own_clock = reply_period > 0.0
        self._since: tuple[int, int] | None = None
        self._told = False

    def look(self, sent: int, good: int, linked: bool) -> Event | None:
        """Take the present totals; return the warning, if one is due."""
        if not linked or self._own_clock:
            self._since, self._told = None, False
            return None
        if self._since is None:
            self._since = sent, good
        lines, answers = sent - self._since[0], good - self._since[1]
        if lines < WINDOW:
            return None
        self._since = sent, good
        told, self._told = self._told, answers < (1.0 - LOST) * lines
        if told or not self._told:
            return None
        return Event(
            "lines_lost",
            f"only {answers} of {lines} lines were answered: the others are lost on the way "
            "there or back, or the microcontroller reports by its own clock; `acsard mcu check` "
            "finds out which",
            "warning",
        )
