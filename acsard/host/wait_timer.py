"""Measures how long an operation of another thread takes, such as a sync of a file to the disk."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

MAX_CALL_INTERVAL_NS = NS_PER_S // 4
"""Largest amount by which one call of `wait_ns` extends the measured time, ns.

If more time passes between two calls, this process itself was stopped. The disk is not the cause of
the rest of that time.
"""


class WaitTimer:
    """Measures how long the present operation of another thread has taken so far.

    The other thread calls `begin` and `end`. The control loop calls `wait_ns` in each period. The
    measured time does not contain a time in which this process was stopped.
    """

    def __init__(self) -> None:
        self._changes = 0
        """Number of begun operations plus number of ended operations. It is odd during an
        operation."""
        self._seen = self._wait_ns = self._now_ns = 0
        """The value of `_changes`, the result and the time of the last call of `wait_ns`."""

    # The other thread calls these methods.

    def begin(self) -> None:
        self._changes += 1

    def end(self) -> None:
        self._changes += 1

    # The control loop calls the methods below.

    def wait_ns(self, now_ns: int) -> int:
        """Return how long the present operation has taken so far, ns; 0 if there is none.

        `now_ns` is the present monotonic time, ns.
        """
        changes = self._changes
        if changes != self._seen:
            self._wait_ns = 0
        elif changes % 2:
            self._wait_ns += min(now_ns - self._now_ns, MAX_CALL_INTERVAL_NS)
        self._seen, self._now_ns = changes, now_ns
        return self._wait_ns

    @property
    def ended(self) -> int:
        """Number of operations that had ended at the last call of `wait_ns`."""
        return self._seen // 2
