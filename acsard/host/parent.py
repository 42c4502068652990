"""A process that ends with the one that started it, however that ends."""

from __future__ import annotations

import ctypes
import signal

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_parent(number: signal.Signals) -> None:
    """Called in the child: be sent this signal when the thread that started us ends."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)
