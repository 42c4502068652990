"""Driving by keys on a terminal that cannot show a screen, and the last report of every drive."""

from __future__ import annotations

import os
import shutil
import sys
import time

from acsard.top.keyboard import Ride
from acsard.top.teleop import HELP, Teleop, moves, news, parting
from acsard.top.terminal import keys, until_told

PERIOD_S = 0.05

NEWS_S, SAME_S, QUIET_S = 0.5, 1.0, 10.0
"""Shortest time between two reports without a screen, s.

In this order, they apply after a change, while the robot moves, and while nothing happens.
"""

PART_S = 2.0
"""Time within which a robot usually stands after its own ramp, s."""

NO_END = 10**9


def drive(ride: Ride) -> None:
    """Drive until a signal; print some lines after each change, and at intervals."""
    due, page = News(), Page()
    with until_told(), keys() as read:
        while (typed := read(PERIOD_S)) is not None:
            ride.step(typed)
            seen = ride.seen()
            if due.tell(seen, time.monotonic()):
                width, height = output_size()
                print("\n".join(page.with_help(news(seen, width), height)), flush=True)


def part(ride: Ride) -> None:
    """Wait until the robot stands, at most `PART_S`, and print a last report.

    Without the wait, this report would say that the robot drives although it stops a moment later.
    """
    left = time.monotonic()
    while os.isatty(0) and os.isatty(1):
        ride.take()
        seen, took = ride.seen(), time.monotonic() - left
        rests = seen.state is not None and seen.age < took and not moves(seen.state)
        if rests or took > PART_S:
            print("\n".join(parting(seen, output_size().columns)), flush=True)
            return
        time.sleep(PERIOD_S)


def output_size() -> os.terminal_size:
    """Return the size of the terminal. A file or a pipe is unlimited."""
    unlimited = os.terminal_size((NO_END, NO_END))
    return shutil.get_terminal_size() if sys.stdout.isatty() else unlimited


class News:
    """Throttle for reports on a terminal that cannot show a screen. The class is pure."""

    def __init__(self) -> None:
        self._shown: tuple[object, ...] = ()
        self._at = -QUIET_S

    def tell(self, seen: Teleop, now: float) -> bool:
        """Return whether a report is due at `now` s, and remember it as printed."""
        state = seen.state
        words = ("", "") if state is None else (state.mode, state.reason)
        what = (*words, seen.objection, seen.linear, seen.angular, seen.silent)
        moves = state is not None and bool(state.linear or state.angular)
        wait = NEWS_S if what != self._shown else SAME_S if moves else QUIET_S
        if now - self._at < wait:
            return False
        self._shown, self._at = what, now
        return True


class Page:
    """Reports with the help, repeated before it scrolls out of sight. The class is pure."""

    def __init__(self) -> None:
        self._shown = NO_END
        """Lines printed since the help began."""

    def with_help(self, told: list[str], height: int) -> list[str]:
        """Return these lines, below the help if they are the first or would scroll it away."""
        self._shown += len(told)
        if self._shown < height:
            return told
        self._shown = len(HELP) + len(told)
        return [*HELP, *told]
