"""What the page's server counts, for `/metrics` and its log."""

from __future__ import annotations

import threading
from collections import Counter

from acsard.web.who import Reason

Count = str


class Counts:
    """Counters by name; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[Count] = Counter()
        self._refused: Counter[Reason] = Counter()

    def add(self, name: Count, more: int = 1) -> None:
        """So many more."""
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason) -> None:
        """One more that was refused."""
        with self._lock:
            self._refused[reason] += 1

    def all(self) -> dict[Count, int]:
        """Up to now."""
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[Reason, int]:
        """The refusals up to now, by reason."""
        with self._lock:
            return dict(self._refused)
