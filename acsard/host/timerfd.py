"""A kernel timer the event loop can wait on, precise where asyncio's own rounds to milliseconds.

asyncio on epoll rounds every wait up; a timerfd wakes it on time and counts what was missed.
Python has the calls from 3.13 on; the C library's serve every version.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from typing import Final

from acsard.host import clock
from acsard.values import NS_PER_S

CLOCK_MONOTONIC: Final = 1
_FLAGS: Final = os.O_NONBLOCK | os.O_CLOEXEC


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


class _Itimerspec(ctypes.Structure):
    _fields_ = [("it_interval", _Timespec), ("it_value", _Timespec)]


class TimerFd:
    """One timer; `fileno` becomes readable when it expires.

    The kernel has none on the clock we read: what is set is how long to wait from now.
    """

    def __init__(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._spec = _Itimerspec()
        self._where = ctypes.byref(self._spec)
        self._settime = libc.timerfd_settime
        self._fd = libc.timerfd_create(CLOCK_MONOTONIC, _FLAGS)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return int(self._fd)

    def set(self, at_ns: int) -> None:
        """Expire at monotonic `at_ns`, once."""
        wait_ns = max(1, at_ns - clock.mono_ns())
        value = self._spec.it_value
        value.tv_sec, value.tv_nsec = divmod(wait_ns, NS_PER_S)
        if self._settime(self._fd, 0, self._where, None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime failed")

    def expirations(self) -> int:
        """How often it expired since the last call; 0 when it has not."""
        try:
            return int.from_bytes(os.read(self._fd, 8), sys.byteorder)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return 0
            raise

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._fd)
