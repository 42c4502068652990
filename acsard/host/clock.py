"""The only place that reads a clock.

The monotonic one is the raw one: NTP slews the other, by up to 8 %, and with it every distance
that is speed times time, and every delay that a command seems to have had.

An `Instant` is in whole us: what is below is only how long the reading took, and a recording that
had to keep it would be twice as large.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from acsard.values import Instant

mono_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC_RAW)
"""The monotonic clock alone. Read a dozen times a period: no Python function around it."""


def asleep_ns() -> int:
    """How long this computer was suspended since it was switched on; `mono_ns` stood meanwhile."""
    awake_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - awake_ns


def steady_ns() -> int:
    """Return a time in ns that nobody adjusts and that goes on while this computer is suspended."""
    return mono_ns() + asleep_ns()


TOGETHER_NS = 50_000
"""Two readings take 1 us, unless another process gets the core between them."""

TRIES = 5

NS_PER_US = 1000


def now() -> Instant:
    """Both clocks, read together."""
    for _ in range(TRIES):
        mono, wall = mono_ns(), time.time_ns()
        if mono_ns() - mono < TOGETHER_NS:
            break
    return Instant(mono - mono % NS_PER_US, wall - wall % NS_PER_US)
