"""Reads a terminal's keys one by one without echo, and restores the terminal at the end."""

from __future__ import annotations

import errno
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from acsard.host.terminal_modes import one_by_one

LEAVES = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def until_told() -> Iterator[None]:
    """End the block at the first terminating signal, or when its terminal closes.

    Later signals are ignored during the cleanup: a terminal that closes under a shell sends two,
    and Ctrl-C may be held down.
    """

    def deaf() -> None:
        for number in LEAVES:
            signal.signal(number, signal.SIG_IGN)

    def leave(*_: object) -> None:
        deaf()
        raise KeyboardInterrupt

    for number in LEAVES:
        signal.signal(number, leave)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        # The terminal was closed, so discard further output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        deaf()


@contextmanager
def keys() -> Iterator[Callable[[float], str | None]]:
    """Yield a function that waits up to a number of seconds for keys.

    The function returns "" if no key was typed, and None when the input has ended.
    """

    def read(seconds: float) -> str | None:
        ready, _, _ = select.select([sys.stdin], [], [], seconds)
        if not ready:
            return ""
        return os.read(sys.stdin.fileno(), 64).decode(errors="replace") or None

    def nobody(seconds: float) -> str:
        time.sleep(seconds)
        return ""

    if not sys.stdin.isatty():
        yield nobody
        return
    with one_by_one():
        yield read
