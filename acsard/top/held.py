"""A terminal that is held by one screen until a key or a signal; ^Z gives it back, fg goes on."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from acsard.top.keys import keys, until_told
from acsard.top.teleop import Teleop

PERIOD_S = 0.25

KEYS_S = 0.05
"""Who drives is looked after so often."""


def hold(shows: Callable[[list[bool]], bool]) -> None:
    """Have a screen until a signal, or until it is over; `shows` ends at ^Z, which it is told by
    what is in its list, and gives True for it."""
    be_lenient()
    suspend: list[bool] = []
    signal.signal(signal.SIGTSTP, lambda *_: suspend.append(True))
    with until_told():
        while shows(suspend):
            suspend.clear()
            os.kill(os.getpid(), signal.SIGSTOP)  # ^Z: the terminal is as it was; fg goes on


def steer(
    step: Callable[[str], None],
    seen: Callable[[], Teleop],
    screen: AbstractContextManager[Callable[[Teleop], None]],
    suspend: list[bool],
) -> bool:
    """Hand the keys to `step`, also when there are none, and what is seen to the screen; True at
    ^Z."""
    with keys() as read, screen as show:
        due = 0.0
        while not suspend:
            typed = read(KEYS_S)
            if typed is None:
                return False
            step(typed)
            if typed or time.monotonic() >= due:
                due = time.monotonic() + PERIOD_S
                show(seen())
    for letter in ("k", "", ""):
        step(letter)  # nobody steps while we are stopped
    return True


def be_lenient() -> None:
    """A terminal without a sign of ours shows another in its place."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
