"""Helpers that replace a file by a named pipe, so that a read hangs as on a failing disk."""

from __future__ import annotations

import threading

ROUNDS_S = 0.5
"""Time, s, in which the server tries to read the file many times, if it uses a thread for each
attempt."""


def threads_named(name: str) -> int:
    """Return the number of running threads with the name `name`."""
    return sum(thread.name == name for thread in threading.enumerate())
