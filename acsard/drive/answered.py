"""Is there an answer to each line? Of a link that is up, and loses some, nothing else would tell.

Told once, until it is well again or the link is lost: a microcontroller that reports by a clock of
its own, at another rate than ours, is no fault, and looks the same.
"""

from __future__ import annotations

from acsard.values import Event

WINDOW = 1000
"""Lines sent that are looked at together: 10 s at 100 Hz."""

LOST = 0.02
"""Share of them from which on it is told; a sound link loses none."""


class Answered:
    """Compares the totals of lines sent and of good lines, window by window."""

    def __init__(self, reply_period: float) -> None:
        """`reply_period` s of an MCU that is known to report by its own clock, else 0."""
        self._own_clock = reply_period > 0.0
        self._since: tuple[int, int] | None = None
        self._told = False

    def look(self, sent: int, good: int, linked: bool) -> Event | None:
        """The totals by now; what there is to tell of them."""
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
            f"of {lines} lines {answers} were answered: the others are lost on the way there or "
            "back, or the microcontroller reports by its own clock; `acsard mcu check` tells which",
            "warning",
        )
