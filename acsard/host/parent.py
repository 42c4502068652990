"""Ends a child process when its parent ends, even if the parent crashes."""

from __future__ import annotations

import ctypes
import signal

# From linux/prctl.h.
PR_SET_PDEATHSIG = 1


def end_with_parent(number: signal.Signals) -> None:
    """Ask the kernel for this signal when the thread that started this process ends.

    The child process calls it.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)
