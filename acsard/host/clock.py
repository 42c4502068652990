"""The only module that reads a clock.

The monotonic clock is CLOCK_MONOTONIC_RAW. NTP slews CLOCK_MONOTONIC by up to 8 %, and with it
every distance that is computed as speed times time, and every apparent delay of a command.

An `Instant` is in whole us. Digits below that show only how long the reading took, and storing them
would make a recording twice as large.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from acsard.values import Instant

mono_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC_RAW)
"""Read the monotonic clock, ns. A dozen reads a period are too many for a Python wrapper."""


def asleep_ns() -> int:
    """Return how long this computer was suspended since its start, ns, while `mono_ns` stood."""
    awake_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - awake_ns


def steady_ns() -> int:
    """Return a time in ns that nobody adjusts and that goes on while this computer is suspended."""
    return mono_ns() + asleep_ns()


TOGETHER_NS = 50_000
"""Longest time between two readings that belong together, ns. Two readings take 1 us, unless
another process gets the core between them.
"""

TRIES = 5

NS_PER_US = 1000


def now() -> Instant:
    """Read both clocks as close together as possible."""
    for _ in range(TRIES):
        mono, wall = mono_ns(), time.time_ns()
        if mono_ns() - mono < TOGETHER_NS:
            break
    return Instant(mono - mono % NS_PER_US, wall - wall % NS_PER_US)
