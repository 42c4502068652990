"""Find out whether all cores of the machine were busy throughout a time.

If so, other programs had the processor time whose lack a test reports as a failure.
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
    """The idle time of the cores at some moment."""

    at: float
    """Monotonic clock, s."""
    idle_s: float
    """Idle time of all cores since the machine started, with that of the idle class."""


def idle() -> Idle:
    """Return the idle time up to now."""
    first, *_ = Path("/proc/stat").read_text().splitlines()
    _, _user, _nice, _system, idles, waits, *_ = first.split()
    spare = (int(idles) + int(waits)) / os.sysconf("SC_CLK_TCK")
    return Idle(time.monotonic(), spare + idle_class())


def idle_class() -> float:
    """Return the processor time of the processes in the kernel's idle class, s.

    These get only the time that no test wants. `.ci/run` computes in this class while tests wait.
    """
    ticks = 0
    for name in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):  # the process has ended meanwhile
            if os.sched_getscheduler(int(name)) == os.SCHED_IDLE:
                stat = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
                # Its own time and that of its children that have ended.
                ticks += sum(map(int, stat[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def taken(before: Idle, after: Idle) -> bool:
    """Return whether hardly any core was free between the two moments."""
    whole = (after.at - before.at) * (os.cpu_count() or 1)
    return after.idle_s - before.idle_s < FREE * whole
