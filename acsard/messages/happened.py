"""The last events as `events` has them: what goes on and on is one row, with how often it was.

A machine that misses a period every second would push a fault out of twenty rows in as many
seconds. What is news stays a row of its own; the log has a line of each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from msgspec import Struct

from acsard.drive.tally import together
from acsard.messages.schema import Events, Happening, Time
from acsard.values import NS_PER_S, Event, Instant

LAST = 20
"""Rows that are kept: more than happens between two looks of who is slow."""

PAUSE_NS = 60 * NS_PER_S
"""Without more of the same for so long, the next one is a row of its own."""


class _Row(Struct, frozen=True):
    at: Instant
    event: Event


class Happened:
    """The last rows, oldest first; one that happens again goes to the end."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque(maxlen=LAST)
        self._total = 0

    def add(self, events: Iterable[Event], now: Instant) -> None:
        """These have just been told."""
        for event in events:
            self._total += 1
            same = None if event.news else self._same(event, now)
            if same is not None:
                self._rows.remove(same)
                event = together(same.event, event)
            self._rows.append(_Row(now, event))

    def told(self) -> Events | None:
        """All that is kept; None when nothing has happened yet."""
        if not self._rows:
            return None
        return Events(_time(self._rows[-1]), self._total, [_happening(row) for row in self._rows])

    def _same(self, event: Event, now: Instant) -> _Row | None:
        """The row that it is more of."""
        since_ns = now.mono_ns - PAUSE_NS
        for row in self._rows:
            if row.event.name == event.name and not row.event.news and row.at.mono_ns >= since_ns:
                return row
        return None


def _time(row: _Row) -> Time:
    return Time.from_ns(row.at.wall_ns)


def _happening(row: _Row) -> Happening:
    one = row.event
    return Happening(_time(row), one.name, one.level, one.text, one.by, one.count)
