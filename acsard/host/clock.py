"""The only place that reads a clock.

The monotonic one is the raw one: NTP slews the other, by up to 8 %, and with it every distance
that is speed times time, and every delay that a command seems to have had.
"""

from __future__ import annotations

import time

from acsard.values import Instant


def mono_ns() -> int:
    """The monotonic clock alone."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def now() -> Instant:
    """Both clocks, read together."""
    return Instant(mono_ns(), time.time_ns())
