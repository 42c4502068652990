"""Keeps the last events for the topic `events`.

An event with `news` has its own row. Others share one with their repetitions and a count, or a
period missed each second would push a fault out within 20 s. The log has its own limit
(`event_throttle.py`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from msgspec import Struct

from acsard.core.messages.schema import Events, LogEvent, Time
from acsard.core.motion.event_throttle import merge
from acsard.core.values import NS_PER_S, Event, Instant

MAX_ROWS = 20  # even a client that polls slowly seldom misses an event

NEW_ROW_AFTER_NS = 60 * NS_PER_S  # between two events that share a row


class _Row(Struct, frozen=True):
    at: Instant
    event: Event


class RecentEvents:
    """The rows of the last events, oldest first; a repetition moves its row to the end."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque(maxlen=MAX_ROWS)
        self._total = 0

    def add(self, events: Iterable[Event], now: Instant) -> None:
        for event in events:
            self._total += 1
            same = None if event.news else self._same(event, now)
            if same is not None:
                self._rows.remove(same)
                event = merge(same.event, event)
            self._rows.append(_Row(now, event))

    def message(self) -> Events | None:
        """Return the message with all rows, or None before the first event."""
        if not self._rows:
            return None
        return Events(_time(self._rows[-1]), self._total, [_log_event(row) for row in self._rows])

    def _same(self, event: Event, now: Instant) -> _Row | None:
        since_ns = now.mono_ns - NEW_ROW_AFTER_NS
        for row in self._rows:
            if row.event.name == event.name and not row.event.news and row.at.mono_ns >= since_ns:
                return row
        return None


def _time(row: _Row) -> Time:
    return Time.from_ns(row.at.wall_ns)


def _log_event(row: _Row) -> LogEvent:
    event = row.event
    return LogEvent(
        _time(row), event.name, event.level, event.text, event.by, event.count, event.code
    )
