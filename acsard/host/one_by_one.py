"""Sets the terminal to deliver single key presses, for driving by keys."""

from __future__ import annotations

import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def one_by_one() -> Iterator[None]:
    """Deliver the keys of standard input one by one, and restore the terminal at the end.

    Ctrl-S is an ordinary key meanwhile. Otherwise it would block the program's output, and with it
    the program that drives the robot.
    """
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    now = termios.tcgetattr(sys.stdin)
    now[0] &= ~termios.IXON
    termios.tcsetattr(sys.stdin, termios.TCSANOW, now)
    try:
        yield
    finally:
        # The terminal may have been closed.
        with suppress(OSError, termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
