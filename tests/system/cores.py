"""Were the machine's cores all taken, all the time? Then others had what a test judges."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

FREE = 0.03
"""Of the time of all cores. Beside four busy loops none is free; in a run of the test command with
nothing beside it about a fifth of each is."""


class Idle(NamedTuple):
    """At some moment."""

    at: float
    """By the monotonic clock, s."""
    idle_s: float
    """What all cores together have idled since the start of the machine."""


def idle() -> Idle:
    """Now."""
    first, *_ = Path("/proc/stat").read_text().splitlines()
    _, _user, _nice, _system, idles, waits, *_ = first.split()
    return Idle(time.monotonic(), (int(idles) + int(waits)) / os.sysconf("SC_CLK_TCK"))


def taken(before: Idle, after: Idle) -> bool:
    """Was hardly a core free between the two?"""
    whole = (after.at - before.at) * (os.cpu_count() or 1)
    return after.idle_s - before.idle_s < FREE * whole
