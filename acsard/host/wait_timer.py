"""Measures how long an operation of another thread takes, such as a sync of a file to the disk."""

from __future__ import annotations

from acsard.core.values import NS_PER_S, Ns

# If more time passes between two calls, this process was stopped, and the rest does not count.
MAX_CALL_INTERVAL_NS = NS_PER_S // 4


class WaitTimer:
    """Measures how long the present operation of another thread has taken so far.

    That thread calls `begin` and `end`, and the control loop `wait_ns`, at least every 0.1 s.
    """

    def __init__(self) -> None:
        self._changes = 0  # begun operations plus ended ones: odd during an operation
        self._seen = self._wait_ns = self._now_ns = 0  # at the last call of `wait_ns`

    # The other thread calls these methods.

    def begin(self) -> None:
        self._changes += 1

    def end(self) -> None:
        self._changes += 1

    # The control loop calls the methods below.

    def wait_ns(self, now_ns: Ns) -> Ns:
        """Return how long the present operation has taken so far; 0 if there is none."""
        changes = self._changes
        if changes != self._seen:
            self._wait_ns = 0
        elif changes % 2:
            self._wait_ns += min(now_ns - self._now_ns, MAX_CALL_INTERVAL_NS)
        self._seen, self._now_ns = changes, now_ns
        return self._wait_ns

    @property
    def ended(self) -> int:
        """Return how many operations had ended at the last call of `wait_ns`."""
        return self._seen // 2
