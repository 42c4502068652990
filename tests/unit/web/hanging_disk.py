"""Helpers for tests in which a read of a file does not return, because the file is a named pipe."""

from __future__ import annotations

import threading

ROUNDS_S = 0.5
"""Time, s, in which the server tries to read the file many times, if it uses a thread for each
attempt."""


def threads_named(name: str) -> int:
    """Return the number of running threads with the name `name`."""
    return sum(thread.name == name for thread in threading.enumerate())
