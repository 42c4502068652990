"""A timer of the kernel that wakes the event loop more precisely than asyncio's own timers.

asyncio rounds every wait up to whole milliseconds. Python itself offers timerfd only from 3.13 on,
so this module calls the C library to set a timer. Reading one needs only `os`.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from typing import Final

from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock

CLOCK_MONOTONIC: Final = 1
TFD_TIMER_ABSTIME: Final = 1


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


class _Itimerspec(ctypes.Structure):
    _fields_ = [("it_interval", _Timespec), ("it_value", _Timespec)]


class TimerFd:
    """A timer whose file descriptor becomes readable when the timer expires.

    The kernel has no timerfd for CLOCK_MONOTONIC_RAW, so `set` passes the remaining time, and
    `repeat` counts by CLOCK_MONOTONIC.
    """

    def __init__(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._spec = _Itimerspec()
        self._where = ctypes.byref(self._spec)
        self._settime = libc.timerfd_settime
        self._fd = libc.timerfd_create(CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")

    def fileno(self) -> int:
        return int(self._fd)

    def set(self, at_ns: Ns) -> None:
        """Let the timer expire once, at a time of `clock.mono_ns`."""
        self._start(max(1, at_ns - clock.mono_ns()), 0, 0)

    def repeat(self, period_ns: Ns) -> Ns:
        """Let the timer expire after each period; return the first time, by `clock.timer_ns`."""
        first_ns = clock.timer_ns() + period_ns
        self._start(first_ns, period_ns, TFD_TIMER_ABSTIME)
        return first_ns

    def _start(self, value_ns: Ns, interval_ns: Ns, flags: int) -> None:
        value, interval = self._spec.it_value, self._spec.it_interval
        value.tv_sec, value.tv_nsec = divmod(value_ns, NS_PER_S)
        interval.tv_sec, interval.tv_nsec = divmod(interval_ns, NS_PER_S)
        if self._settime(self._fd, flags, self._where, None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")

    def expirations(self) -> int:
        """Return how many times the timer has expired since the last call."""
        try:
            return int.from_bytes(os.read(self._fd, 8), sys.byteorder)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return 0
            raise

    def close(self) -> None:
        os.close(self._fd)
