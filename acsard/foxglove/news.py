"""The daemon's events as lines of a log, each once; pure."""

from __future__ import annotations

from acsard.messages.schema import Events
from acsard.ros.shapes import Log, log


class News:
    """Knows how many there were, and when the last was."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0

    def of(self, events: Events) -> list[Log]:
        """Those that are new; of a daemon not heard before all that it still knows."""
        known, stamp_ns = self._total, events.stamp.to_ns()
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # what was asked for, overtaken by what came by itself
            known = 0  # another daemon
        self._total, self._stamp_ns = events.total, stamp_ns
        new = min(events.total - known, len(events.events))
        return [log(one, one.stamp) for one in events.events[len(events.events) - new :]]
