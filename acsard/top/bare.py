"""The screen of `acsard drive` without the library rich: the same lines, without colours."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from acsard.top.held import hold, steer
from acsard.top.teleop import Teleop, lines

ENTER, LEAVE = "\x1b[?1049h\x1b[?25l\x1b[?7l", "\x1b[?7h\x1b[?25h\x1b[?1049l"
"""Escape sequences: an alternate screen without a cursor and without line wrap, and back.

Without line wrap, a character that is wider than expected is cut instead of breaking the layout.
"""

HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
"""Escape sequences: move to the top left, clear a line, clear everything below.

Each line is cleared from its beginning, because after a full line the cursor still stands on its
last character.
"""


def drive(step: Callable[[str], None], seen: Callable[[], Teleop]) -> None:
    """Pass the typed keys to `step`, "" if none, and show the result of `seen`, until a signal."""
    hold(lambda suspend: steer(step, seen, _screen(), suspend))


@contextmanager
def _screen() -> Iterator[Callable[[Teleop], None]]:
    def show(seen: Teleop) -> None:
        width, height = shutil.get_terminal_size()
        told = [CLEAR_LINE + text for _, text in lines(seen, width, height)]
        below = [CLEAR_BELOW] if len(told) < height else []
        _write(HOME + "\n".join(told + below))

    _write(ENTER)
    try:
        yield show
    finally:
        _write(LEAVE)


def _write(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()
