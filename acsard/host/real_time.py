"""What the operating system can do for punctuality: asked for once, before any thread starts.

Only the control loop's own thread becomes real-time: what it starts (the bus's threads, children)
does not inherit it, so that no flood on the bus competes with the loop.
"""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path

PRIORITY = 10
"""Ahead of everything that is not real-time, behind the kernel's own interrupt threads (50)."""

SPIN_S = 1
"""How long the loop may run in one go before the kernel ends it: it is ahead of everything else
on its core, and a step takes a thousandth of this."""

DOZE = "/dev/cpu_dma_latency"
"""The kernel's device for how long a processor may take to wake."""

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def ask() -> str:
    """Ask for all of it; what was refused and the mend, or ""."""
    asked = {
        "real-time scheduling": _schedule(),
        "locked memory": _lock(),
        "an awake processor": _stay_awake(),
    }
    refused = [what for what, granted in asked.items() if not granted]
    if not refused:
        return ""
    return (
        f"no permission for {', '.join(refused)}: a period or a command can be late; the service "
        "(acsard service install) has it, or give the user rtprio 10 and memlock unlimited in "
        "/etc/security/limits.conf, or set control.real_time = false to do without"
    )


def has(pid: int) -> bool | None:
    """Whether the first thread of a process, a daemon's loop, is real-time; None where that cannot
    be seen."""
    try:
        policy = os.sched_getscheduler(pid)
    except OSError:
        return None
    return policy & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR)


def allowed() -> bool:
    """Whether a daemon that we start would get it: by the capability, or by the limit; root
    without the capability, as in a container, is held to the limit like anybody else."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    return _capable(_CAP_SYS_NICE) or limit == resource.RLIM_INFINITY or limit >= PRIORITY


def _capable(capability: int) -> bool:
    effective = Path("/proc/self/status").read_text().partition("CapEff:")[2].split()[0]
    return bool(int(effective, 16) >> capability & 1)


def _schedule() -> bool:
    if has(0):
        return True  # as systemd started us
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        resource.setrlimit(resource.RLIMIT_RTTIME, (SPIN_S * 1_000_000, SPIN_S * 1_000_000))
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


def _stay_awake() -> bool:
    """A processor that dozes between steps takes longer to wake, and finds its caches cold."""
    try:
        wish = os.open(DOZE, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return True  # this kernel does not let anybody ask
    except OSError:
        return False
    os.write(wish, bytes(4))  # 0 us, for as long as it is open: until we end
    return True


def _lock() -> bool:
    # Under a finite limit the call might succeed and a later allocation fail: all or nothing. Root
    # without the capability, as in a container, is held to the limit like anybody else.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not unlimited and not _capable(_CAP_IPC_LOCK):
        return False
    # As pages are touched: to lock whole thread stacks and arenas would take ten times the memory.
    flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    return bool(ctypes.CDLL(None).mlockall(flags) == 0)
