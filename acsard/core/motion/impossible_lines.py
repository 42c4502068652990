"""Warns if many lines are impossible.

An impossible line now and then is damage on a plain line, and dropping it is the purpose of the
check. With more than one in a hundred, either the wire is bad or the bound is, and true lines are
lost.
"""

from __future__ import annotations

from acsard.core.values import Event

WINDOW = 1000
"""Lines that are examined together: 10 s at 100 Hz."""

SHARE = 0.01
"""Share of a window's lines that causes a warning, once per window."""


class ImpossibleLines:
    """A count of the dropped lines in each window."""

    def __init__(self) -> None:
        self._lines = self._count = 0

    def line(self, why: str) -> Event | None:
        """Take the next line, with the reason if it was dropped, else ""; return a due warning."""
        self._lines += 1
        event = None
        if why:
            self._count += 1
            if self._count == int(SHARE * WINDOW) + 1:
                event = Event("lines_implausible", self._words(why), "warning")
        if self._lines == WINDOW:
            self._lines = self._count = 0
        return event

    def _words(self, why: str) -> str:
        return (
            f"{self._count} of {self._lines} lines were dropped, as no wheel can do what they say; "
            f"the last: {why}. If a wheel does, raise that setting. Else lines come damaged: look "
            'at cable and ground; firmware that knows mcu.link_check = "auto" proves each line'
        )
