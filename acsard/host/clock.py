"""The only place that reads a clock."""

from __future__ import annotations

import time

from acsard.values import Instant


def mono_ns() -> int:
    """The monotonic clock alone."""
    return time.monotonic_ns()


def now() -> Instant:
    """Both clocks, read together."""
    return Instant(time.monotonic_ns(), time.time_ns())
