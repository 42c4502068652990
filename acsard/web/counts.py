"""What the page's server counts, for `/metrics` and its log."""

from __future__ import annotations

import threading
from collections import Counter

from acsard.values import Event
from acsard.web.who import Reason

NAMED = 5
"""Who was refused is named, those first who were most often."""

KNOWN = 1000
"""So many are told apart between two lines, however many addresses somebody has."""


class Counts:
    """Counters by name; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._told: Counter[str] = Counter()
        self._origins: Counter[str] = Counter()
        """Who was refused since the last line."""

    def add(self, name: str, more: int = 1) -> None:
        """So many more."""
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason, origin: str = "") -> None:
        """One more that was refused, and where that came from, "" where nobody knows."""
        with self._lock:
            self._refused[reason] += 1
            if origin and (origin in self._origins or len(self._origins) < KNOWN):
                self._origins[origin] += 1

    def all(self) -> dict[str, int]:
        """Up to now."""
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[str, int]:
        """The refusals up to now, by reason."""
        with self._lock:
            return dict(self._refused)

    def news(self) -> Event | None:
        """The refusals since the last call, for the log; None where there are none."""
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
