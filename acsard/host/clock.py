"""Reads the clocks of this computer, and detects a suspend. No other module of the daemon does.

The monotonic clock is CLOCK_MONOTONIC_RAW: NTP makes CLOCK_MONOTONIC up to 8 % faster or slower,
and distances and delays with it. The times in an `Instant` are whole microseconds. Reading the
clocks takes about 1 us, and more digits would double a recording.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from acsard.core.values import NS_PER_S, NS_PER_US, Instant, Ns

# A `partial`, because a Python function would be slower.
mono_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC_RAW)


# The clock of the kernel's timers.
timer_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC)

# The clock of the beats, which also runs during a suspend.
boot_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)


def asleep_ns() -> Ns:
    """Return the total time for which this computer has been suspended since its start."""
    awake_ns = timer_ns()
    return boot_ns() - awake_ns


def steady_ns() -> Ns:
    """Return the time of a clock that is never adjusted and also runs during a suspend."""
    return mono_ns() + asleep_ns()


def steady_s() -> float:
    """Return `steady_ns` in s, for the ages of commands and states.

    With a clock that stands still, those from before a suspend would seem fresh.
    """
    return steady_ns() / NS_PER_S


def now() -> Instant:
    """Return the present time, by two clocks that are read within 50 us of each other.

    After five slower attempts the last one counts.
    """
    for _ in range(5):
        mono, wall = mono_ns(), time.time_ns()
        # Two readings take 1 us, unless another process gets the processor between them.
        if mono_ns() - mono < 50_000:
            break
    return Instant(mono - mono % NS_PER_US, wall - wall % NS_PER_US)


# The clocks of `asleep_ns` are not read at the same moment, so it varies a little. Every real
# suspend takes longer than this.
MIN_SUSPEND_NS = 100_000_000


class SuspendDetector:
    """Reports each suspend of this computer once.

    The monotonic clock stands still meanwhile, so older commands and speeds would seem fresh.
    """

    def __init__(self, read: Callable[[], int] = asleep_ns) -> None:
        self._read, self._known_ns = read, read()

    def detect(self) -> bool:
        """Return whether this computer was suspended since the last call; short ones add up."""
        if self._read() - self._known_ns < MIN_SUSPEND_NS:
            return False
        # `read` reads two clocks, and the difference is wrong if another process ran in between. So
        # a second reading must confirm the suspend.
        now_ns = self._read()
        slept, self._known_ns = now_ns - self._known_ns >= MIN_SUSPEND_NS, now_ns
        return slept
