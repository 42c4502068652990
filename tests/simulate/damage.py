"""The promise that the daemon soon decodes lines again after damaged ones.

A line is whole if it contains the speed of each motor and nothing else. After a damaged line the
daemon may lose two whole lines, because it must find the line ends again.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from tests.simulate.promises import BrokenError
from tests.simulate.wiring import line_pattern

LOST = 2
"""Whole lines behind a damaged one that the daemon need not hear."""

JUDGED = 3
"""Whole lines behind these, all of which the daemon must have counted."""

STEP_NS = 200_000_000
"""Time within which a line is counted: one that comes while a step stalls waits for the next."""

MAX_LINE = 4096
"""Bytes without an end of line that are kept."""


class Damage:
    """The lines that the board sent, and how many whole ones followed the last damaged one."""

    def __init__(self, config: dict[str, Any]) -> None:
        self._line = re.compile(line_pattern(config).pattern + rb"(?:, *)?\r?")
        self.forget()

    def forget(self) -> None:
        """Restart, because the port was opened again or something else interrupted the lines."""
        self._held = b""
        self._whole = -1
        """Whole lines since the last damaged one, -1 before the first damaged one."""
        self._counted: int | None = None
        """Lines that the daemon had counted behind the lines that it may lose."""
        self._then = 0
        self._short_ns: int | None = None
        """Since when fewer lines are counted than came."""

    def fed(self, data: bytes) -> None:
        """Add bytes of the board that reached the daemon."""
        *ends, rest = (self._held + data).split(b"\n")
        for line in ends:
            if self._line.fullmatch(line):
                self._whole += self._whole >= 0
            elif line not in (b"", b"\r") and not line.startswith(b"!status "):
                self._whole, self._counted, self._short_ns = 0, None, None
        self._held = rest[-MAX_LINE:]

    def judge(self, at_ns: int, lines: Callable[[], int], stalled: bool = False) -> None:
        """Judge a step.

        `lines` returns the number of valid lines that the daemon has counted. If the step
        `stalled`, the daemon reads the lines of that time only in the next step.
        """
        if stalled:
            self._short_ns = None
        if stalled or self._whole < LOST:
            return
        if self._counted is None:
            self._counted, self._then = lines(), self._whole
            return
        expected = self._whole - self._then
        if expected < JUDGED:
            return
        counted = lines() - self._counted
        if counted < expected:
            since_ns = self._short_ns = self._short_ns or at_ns
            if at_ns - since_ns < STEP_NS:
                return
            text = f"{expected} whole lines came, and {counted} are counted"
            raise BrokenError("whole lines are heard behind damaged ones", at_ns, text)
        self._whole, self._counted, self._short_ns = -1, None, None
