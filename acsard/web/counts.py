"""What the page's server counts, for `/metrics` and its log."""

from __future__ import annotations

import threading
from collections import Counter

from acsard.values import Event
from acsard.web.who import Reason


class Counts:
    """Counters by name; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._told: Counter[str] = Counter()

    def add(self, name: str, more: int = 1) -> None:
        """So many more."""
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason) -> None:
        """One more that was refused."""
        with self._lock:
            self._refused[reason] += 1

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
        if not new:
            return None
        said = [f"{count} {reason.replace('_', ' ')}" for reason, count in new.most_common()]
        return Event("page_refused", ", ".join(said), "warning", count=new.total())
