"""Reads the clocks of this computer, and detects that this computer was suspended.

In the daemon, no other module reads a clock. The daemon's monotonic clock is CLOCK_MONOTONIC_RAW,
because NTP makes CLOCK_MONOTONIC up to 8 % faster or slower. With CLOCK_MONOTONIC, distances and
delays would be wrong by the same percentage.

The times in an `Instant` are whole microseconds. More precision would make a recording twice as
large. It would also be useless, because reading the clocks takes about 1 us.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from acsard.core.values import NS_PER_S, Instant

mono_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC_RAW)
"""Function that returns the time of the daemon's monotonic clock, ns. It is a `partial`, because a
Python function would be slower."""


def asleep_ns() -> int:
    """Return the total time for which this computer has been suspended since its start, ns."""
    awake_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - awake_ns


def steady_ns() -> int:
    """Return the time of a clock that is never adjusted and that also runs during a suspend, ns."""
    return mono_ns() + asleep_ns()


def steady_s() -> float:
    """Return the time of a clock that is never adjusted and also runs during a suspend, s.

    Programs that send commands or show states use this clock for the ages of commands and states.
    With a clock that stands still during a suspend, a command or a state from before the suspend
    would seem fresh.
    """
    return steady_ns() / NS_PER_S


NS_PER_US = 1000


def now() -> Instant:
    """Return the present time by the monotonic clock and by the wall clock.

    The two clocks are read within 50 us of each other. If five attempts take longer, the last one
    is returned, and its two times may differ by more.
    """
    for _ in range(5):
        mono, wall = mono_ns(), time.time_ns()
        # Two readings take 1 us, unless another process gets the processor between them.
        if mono_ns() - mono < 50_000:
            break
    return Instant(mono - mono % NS_PER_US, wall - wall % NS_PER_US)


MIN_SUSPEND_NS = 100_000_000
"""Shortest time that counts as a suspend, ns. Every real suspend takes longer. `asleep_ns` does not
read its two clocks at the same moment, so its result varies a little even without a suspend."""


class SuspendDetector:
    """Detector that reports each suspend of this computer once.

    The daemon's monotonic clock stands still during a suspend. Without this detector, commands and
    wheel speeds from before the suspend would seem fresh.
    """

    def __init__(self, read: Callable[[], int] = asleep_ns) -> None:
        self._read, self._known_ns = read, read()

    def detect(self) -> bool:
        """Return whether this computer has been suspended since the last call.

        A suspend of less than 0.1 s (`MIN_SUSPEND_NS`) does not count yet. The next call adds its
        duration to any later suspend.
        """
        if self._read() - self._known_ns < MIN_SUSPEND_NS:
            return False
        # `read` reads two clocks, and the difference is wrong if another process ran in between. So
        # a second reading must confirm the suspend.
        now_ns = self._read()
        slept, self._known_ns = now_ns - self._known_ns >= MIN_SUSPEND_NS, now_ns
        return slept
