"""Limits how often something may be repeated."""

from __future__ import annotations


class Throttle:
    """A limiter that passes one event and the next only after a given time."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        """Monotonic time of the last event that passed, None before the first."""
        self._before_ns: int | None = None

    def lets(self, now_ns: int, wait_ns: int) -> bool:
        """Return whether an event may pass now, `wait_ns` after the last.

        If so it becomes the last.
        """
        if self.last_ns is not None and now_ns - self.last_ns < wait_ns:
            return False
        self._before_ns, self.last_ns = self.last_ns, now_ns
        return True

    def undo(self) -> None:
        """Forget the last event, because its line did not leave. The next line need not wait."""
        self.last_ns = self._before_ns
