"""Decides whether output may contain colors, and makes the terminal deliver single key presses."""

from __future__ import annotations

import os
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO


def may_use_color(stream: TextIO) -> bool:
    """Return whether the stream is a terminal with colors, and NO_COLOR is not set."""
    wanted = not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    return wanted and stream.isatty()


@contextmanager
def single_key_mode() -> Iterator[None]:
    """Make the terminal deliver each key immediately during a `with` block.

    Ctrl-S is an ordinary key there: it would stop the output, and so a program that drives the
    robot.
    """
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    now = termios.tcgetattr(sys.stdin)
    now[0] &= ~termios.IXON
    termios.tcsetattr(sys.stdin, termios.TCSANOW, now)
    try:
        yield
    finally:
        # Do not wait for the output (TCSADRAIN), because a terminal may not read any more. It may
        # also have been closed.
        with suppress(OSError, termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSANOW, before)
