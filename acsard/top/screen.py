"""A terminal screen that ends with a key or a signal. ^Z suspends it, and `fg` resumes."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from acsard.top.key_reader import keys, until_told
from acsard.top.teleop import Teleop

PERIOD_S = 0.25

KEYS_S = 0.05
"""Interval at which the keys are read and the robot is driven."""


def hold(shows: Callable[[list[bool]], bool]) -> None:
    """Show a screen until a signal arrives or `shows` returns False.

    `shows` gets a list that becomes non-empty when the user presses ^Z. It must then leave its
    screen and return True, and is called again after `fg`.
    """
    be_lenient()
    suspend: list[bool] = []
    signal.signal(signal.SIGTSTP, lambda *_: suspend.append(True))
    with until_told():
        while shows(suspend):
            suspend.clear()
            os.kill(os.getpid(), signal.SIGSTOP)  # suspend as ^Z does; fg resumes here


def steer(
    step: Callable[[str], None],
    seen: Callable[[], Teleop],
    screen: AbstractContextManager[Callable[[Teleop], None]],
    suspend: list[bool],
) -> bool:
    """Pass the typed keys to `step`, "" if none, and show the screen.

    Return True at ^Z and False when the input ends.
    """
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
        step(letter)  # stop the robot: no steps run while suspended
    return True


def be_lenient() -> None:
    """Replace characters that the terminal's encoding lacks, instead of failing."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
