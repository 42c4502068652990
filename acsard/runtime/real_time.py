"""What the operating system can do for punctuality: asked for once, before any thread starts.

Only the control loop's own thread becomes real-time: what it starts (the bus's threads, children)
does not inherit it, so that no flood on the bus competes with the loop.
"""

from __future__ import annotations

import ctypes
import os
import resource
import sys

PRIORITY = 10
"""Ahead of everything that is not real-time, behind the kernel's own interrupt threads (50)."""

SWITCH_INTERVAL_S = 0.0005
"""How long another Python thread may hold up the loop; by default 5 ms, half a period."""

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def ask() -> str:
    """Ask for real-time scheduling and locked memory; what was refused and the mend, or ""."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    refused = [
        what
        for what, granted in (("real-time scheduling", _schedule()), ("locked memory", _lock()))
        if not granted
    ]
    if not refused:
        return ""
    return (
        f"no permission for {' and '.join(refused)}: load on this computer can delay a period; "
        "the service (acsard service install) has it, or give the user rtprio and memlock in "
        "/etc/security/limits.conf, or set control.real_time = false to do without"
    )


def _schedule() -> bool:
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR):
        return True  # as systemd started us
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


def _lock() -> bool:
    # Under a finite limit the call might succeed and a later allocation fail: all or nothing.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not unlimited and os.geteuid() != 0:
        return False
    # As pages are touched: to lock whole thread stacks and arenas would take ten times the memory.
    flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    return bool(ctypes.CDLL(None).mlockall(flags) == 0)
