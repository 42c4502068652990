"""A terminal whose keys come one by one, for who drives by them."""

from __future__ import annotations

import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def one_by_one() -> Iterator[None]:
    """Standard input, which is left as it was. Ctrl-S is a key like any other: it must not hold up
    what is written, and with it who writes and drives."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    now = termios.tcgetattr(sys.stdin)
    now[0] &= ~termios.IXON
    termios.tcsetattr(sys.stdin, termios.TCSANOW, now)
    try:
        yield
    finally:
        with suppress(OSError, termios.error):  # the terminal has been closed
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
