"""The daemon's events as lines of a log, each once; pure."""

from __future__ import annotations

from acsard.messages.schema import Events, Happening
from acsard.ros.shapes import Log, log


class News:
    """Knows how many there were, when the last was, and the last ones."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._told: list[Happening] = []

    def of(self, events: Events) -> list[Log]:
        """Those that are new; of a daemon not heard before all that it still knows."""
        known, told, stamp_ns = self._total, self._told, events.stamp.to_ns()
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # what was asked for, overtaken by what came by itself
            known, told = 0, []  # another daemon
        self._total, self._stamp_ns, self._told = events.total, stamp_ns, events.events
        new = min(events.total - known, len(events.events))
        last = events.events[len(events.events) - new :]
        # One that goes on is several of the total, and one here.
        return [log(one, one.stamp) for one in last if one not in told]
