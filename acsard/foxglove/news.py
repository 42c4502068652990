"""The daemon's events as lines of a log, each once; pure."""

from __future__ import annotations

from acsard.messages.schema import Events
from acsard.ros.shapes import Log, log


class News:
    """Knows how many there were."""

    def __init__(self) -> None:
        self._total = 0

    def of(self, events: Events) -> list[Log]:
        """Those that are new; of a daemon not heard before all that it still knows."""
        known = self._total if events.total >= self._total else 0  # another daemon
        self._total = events.total
        new = min(events.total - known, len(events.events))
        return [log(one, one.stamp) for one in events.events[len(events.events) - new :]]
