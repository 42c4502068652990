"""Find out whether other programs kept all cores busy during a test.

If so, the test may have failed only because it got too little processor time.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

FREE = 0.03
"""Share of the time of all cores.

With four busy loops running none is free. During a run of the test command alone about a fifth of
each core is free.
"""


class Idle(NamedTuple):
    """The idle time of all cores up to a moment."""

    at: float
    """Monotonic clock, s."""
    idle_s: float
    """Idle time of all cores since the machine started, with that of the idle class."""


def idle() -> Idle:
    """Return the present time, and the idle time of all cores so far."""
    first, *_ = Path("/proc/stat").read_text().splitlines()
    _, _user, _nice, _system, idles, waits, *_ = first.split()
    spare = (int(idles) + int(waits)) / os.sysconf("SC_CLK_TCK")
    return Idle(time.monotonic(), spare + idle_class())


def idle_class() -> float:
    """Return the processor time of all processes in the kernel's idle class, s.

    The kernel runs them only while a core is otherwise idle. `.ci/run` uses this class while tests
    wait.
    """
    ticks = 0
    for name in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):  # the process has ended meanwhile
            if os.sched_getscheduler(int(name)) == os.SCHED_IDLE:
                stat = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
                # Its own time and that of its children that have ended.
                ticks += sum(map(int, stat[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def cores_were_busy(before: Idle, after: Idle) -> bool:
    """Return whether nearly all cores were busy all the time between the two moments."""
    whole = (after.at - before.at) * (os.cpu_count() or 1)
    return after.idle_s - before.idle_s < FREE * whole
