"""Asks the operating system for punctual scheduling, once, before any thread starts.

Only the control loop's own thread gets real-time priority. The threads of the bus and child
processes do not inherit this priority, so that a flood on the bus does not compete with the loop.
"""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path

PRIORITY = 10  # the kernel's interrupt threads have 50

# Seconds after which the kernel ends a loop that hangs, which would block all ordinary programs. A
# step takes a thousandth. systemd's watchdog does this for the service.
MAX_SPIN_S = 1

# With a lower hard limit of RLIMIT_RTTIME, the kernel could end the daemon during its start.
MIN_SPIN_S = 0.5

WAKE_UP_LATENCY = "/dev/cpu_dma_latency"  # limits the time that a processor takes to wake up

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def request() -> str:
    """Ask for real-time scheduling, locked memory and a processor that stays awake.

    Return "", or a text for the user that names the refused requests and the ways to get
    permission.
    """
    asked = {
        "real-time scheduling": _schedule(),
        "locked memory": _lock(),
        "keeping the processor awake": _stay_awake(),
    }
    refused = [what for what, granted in asked.items() if not granted]
    if not refused:
        return ""
    return (
        f"the daemon has no permission for {', '.join(refused)}, so a control period or a command "
        "can be late. Either run the daemon as the systemd service, which has permission (acsard "
        "service install), or give the user who runs it the limits rtprio 10 and memlock unlimited "
        "in /etc/security/limits.conf, or set control.real_time = false"
    )


def is_real_time(pid: int) -> bool | None:
    """Return whether a process's first thread (the control loop) is real-time; None if unknown.

    `pid` 0 stands for the calling thread.
    """
    try:
        policy = os.sched_getscheduler(pid)
    except OSError:
        return None
    return policy & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR)


def allowed() -> bool:
    """Return whether a daemon of this user would get real-time scheduling.

    In a container, even root may lack CAP_SYS_NICE.
    """
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    return _capable(_CAP_SYS_NICE) or limit == resource.RLIM_INFINITY or limit >= PRIORITY


def _capable(capability: int) -> bool:
    effective = Path("/proc/self/status").read_text().partition("CapEff:")[2].split()[0]
    return bool(int(effective, 16) >> capability & 1)


def _schedule() -> bool:
    if is_real_time(0):
        # systemd has started this process with real-time scheduling.
        return True
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        spin_us, hard_us = MAX_SPIN_S * 1_000_000, resource.getrlimit(resource.RLIMIT_RTTIME)[1]
        if hard_us != resource.RLIM_INFINITY:
            if hard_us < MIN_SPIN_S * 1_000_000:
                return False
            # Without CAP_SYS_RESOURCE, a process cannot raise its hard limit.
            spin_us = min(spin_us, hard_us)
        resource.setrlimit(resource.RLIMIT_RTTIME, (spin_us, spin_us))
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


def _stay_awake() -> bool:
    # A processor in deep sleep wakes late and with cold caches.
    try:
        wish = os.open(WAKE_UP_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        # This kernel does not offer the device.
        return True
    except OSError:
        return False
    # The limit is 0 us. It is in force while the file is open, which is until this process ends.
    os.write(wish, bytes(4))
    return True


def _lock() -> bool:
    # With a finite limit this call might succeed, but a later allocation might fail. So lock memory
    # only without a limit, or with the capability that overrides the limit. Root lacks the
    # capability in some containers.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not unlimited and not _capable(_CAP_IPC_LOCK):
        return False
    # Lock each page only when it is first used. Locking whole thread stacks and arenas would take
    # ten times the memory.
    flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    return bool(ctypes.CDLL(None).mlockall(flags) == 0)
