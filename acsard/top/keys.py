"""The keys of a terminal, one by one and unseen, until a signal; what is left is as it was."""

from __future__ import annotations

import errno
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from acsard.host.one_by_one import one_by_one

LEAVES = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def until_told() -> Iterator[None]:
    """Ends what is done within at the first signal that ends a program, or with its terminal.

    No later one disturbs what is done behind it: a terminal that is closed under a shell sends two,
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
        # The terminal has been closed: nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        deaf()


@contextmanager
def keys() -> Iterator[Callable[[float], str | None]]:
    """Yields what waits at most so many seconds for keys: None when the terminal has ended."""

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
