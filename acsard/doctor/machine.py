"""Examines the machine: programs that take serial ports, the clock, and real-time scheduling."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from acsard.doctor.finding import Finding
from acsard.host import clock, real_time
from acsard.host.processes import running
from acsard.values import NS_PER_S

REAL = "run it as the service (deploy/systemd), which has it; without, load adds lateness"

LEAST_YEAR = 2026
"""Year before which a clock was never set. Boards without a battery start in the past."""


def meddlers() -> Iterator[Finding]:
    """Yield findings about programs that take or disturb serial ports."""
    if running("brltty"):
        mend = "sudo apt remove brltty, unless you read Braille: it takes CH340 and FTDI ports"
        yield Finding("brltty", "failure", "runs", mend)
    if running("ModemManager") and not Path("/etc/udev/rules.d/70-acsar.rules").is_file():
        mend = "install deploy/udev/70-acsar.rules (`acsard service install` does)"
        yield Finding("ModemManager", "warning", "runs, and talks to new serial ports", mend)


def clock_set() -> Iterator[Finding]:
    """Yield a finding about the wall clock, which the stamps depend on."""
    year = time.gmtime(clock.now().wall_ns / NS_PER_S).tm_year
    if year < LEAST_YEAR:
        mend = "set it (timedatectl), or let chrony do; odometry stamps are wall-clock times"
        yield Finding("clock", "warning", f"stands in {year}", mend)
    else:
        yield Finding("clock", "ok", f"stands in {year}")


def scheduling(wanted: bool, pid: int | None) -> Iterator[Finding]:
    """Yield a finding about real-time scheduling.

    Args:
        wanted: the setting control.real_time.
        pid: the process of the daemon on this machine; without one, the rights of this process
            count.
    """
    has = None if pid is None else real_time.has(pid)
    if not wanted:
        yield Finding("real time", "ok", "is not asked for (control.real_time = false)")
    elif has:
        yield Finding("real time", "ok", f"the daemon that runs (pid {pid}) has it")
    elif has is False:
        yield Finding("real time", "warning", f"the daemon that runs (pid {pid}) has none", REAL)
    elif real_time.allowed():
        yield Finding("real time", "ok", "may be asked for")
    else:
        yield Finding("real time", "warning", "is not allowed for you", REAL)
