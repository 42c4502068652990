"""Counters of the page's server, for `/metrics` and the log."""

from __future__ import annotations

import threading
from collections import Counter

from acsard.core.values import Event
from acsard.web.callers import Reason

NAMED = 5
"""Number of origins that one log line names, starting with the most frequent."""

KNOWN = 1000
"""Maximum number of origins that are counted separately between two log lines. The bound holds even
if a client uses many addresses."""


class Counts:
    """Thread-safe counters by name."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._told: Counter[str] = Counter()
        self._origins: Counter[str] = Counter()
        """Refusals since the last log line, by origin."""

    def add(self, name: str, more: int = 1) -> None:
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason, origin: str = "") -> None:
        """Count a refusal; `origin` is its source, or "" if it is unknown."""
        with self._lock:
            self._refused[reason] += 1
            if origin and (origin in self._origins or len(self._origins) < KNOWN):
                self._origins[origin] += 1

    def all(self) -> dict[str, int]:
        """Return the counters since the start."""
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[str, int]:
        """Return the refusals since the start, by reason."""
        with self._lock:
            return dict(self._refused)

    def news(self) -> Event | None:
        """Return a log event for the refusals since the last call, or None if there were none."""
        with self._lock:
            new = self._refused - self._told
            self._told = Counter(self._refused)
            origins, self._origins = self._origins, Counter()
        if not new:
            return None
        said = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in new.most_common())
        named = origins.most_common(NAMED)
        whom = ", ".join(f"{count} from {origin}" for origin, count in named)
        if others := new.total() - sum(count for _, count in named):
            whom += f", {others} from others" if whom else ""
        text = f"{said}; {whom}" if whom else said
        return Event("page_refused", text, "warning", count=new.total())
