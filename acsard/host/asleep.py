"""Was this computer suspended? The clock that counts for us stands still meanwhile.

A command of before would be as fresh as it was, and the speeds of the wheels, which stood.
"""

from __future__ import annotations

from collections.abc import Callable

from acsard.host.clock import asleep_ns

MOMENT_NS = 100_000_000
"""A sleep takes longer; a clock that is set anew by NTP moves both."""


class Asleep:
    """Asked now and then, tells of each sleep once."""

    def __init__(self, read: Callable[[], int] = asleep_ns) -> None:
        """`read` tells how long it was suspended until now, ns."""
        self._read, self._known_ns = read, read()

    def was(self) -> bool:
        """Whether it has been suspended since it was asked last."""
        if self._read() - self._known_ns < MOMENT_NS:
            return False
        # Between the two clocks of one reading somebody else may have had the processor.
        now_ns = self._read()
        slept, self._known_ns = now_ns - self._known_ns >= MOMENT_NS, now_ns
        return slept
