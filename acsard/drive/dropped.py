"""Lines that cannot be true: how many of them are too many, and what to do about it.

One now and then is damage on a plain line, and dropping it is what the check is for. Over one in a
hundred is worth saying: then either the wire is bad or the bound is, and true lines are lost.
"""

from __future__ import annotations

from acsard.values import Event

WINDOW = 1000
"""Lines that are looked at together: 10 s at 100 Hz."""

SHARE = 0.01
"""Of a window, from which on it is told: once in each."""


class Dropped:
    """Counts what was dropped of each window."""

    def __init__(self) -> None:
        self._lines = self._count = 0

    def line(self, why: str) -> Event | None:
        """The next line, with why it was dropped or ""; what there is to tell of it."""
        self._lines += 1
        event = None
        if why:
            self._count += 1
            if self._count == int(SHARE * WINDOW) + 1:
                event = Event("lines_dropped", self._words(why), "warning")
        if self._lines == WINDOW:
            self._lines = self._count = 0
        return event

    def _words(self, why: str) -> str:
        return (
            f"{self._count} of {self._lines} lines were dropped, as no wheel can do what they say; "
            f"the last: {why}. If a wheel does, raise that setting. Else lines come damaged: look "
            'at cable and ground; firmware that knows mcu.link_check = "auto" proves each line'
        )
