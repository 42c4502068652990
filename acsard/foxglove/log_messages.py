"""The daemon's events as log lines, each once. This module is pure."""

from __future__ import annotations

from acsard.core.messages.schema import Events, LogEvent
from acsard.core.ros.shapes import Log, log


class News:
    """Remembers the total count, the stamp and the content of the last event list."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._told: list[LogEvent] = []

    def of(self, events: Events) -> list[Log]:
        """Return the new events as log lines.

        After a restart of the daemon, return all events that it still knows.
        """
        known, told, stamp_ns = self._total, self._told, events.stamp.to_ns()
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # an older answer that arrived after a published list
            known, told = 0, []  # the daemon was restarted
        self._total, self._stamp_ns, self._told = events.total, stamp_ns, events.events
        new = min(events.total - known, len(events.events))
        last = events.events[len(events.events) - new :]
        # An event that lasts counts several times in the total but appears once in the list.
        return [log(one, one.stamp) for one in last if one not in told]
