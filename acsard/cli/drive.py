"""`acsard drive`: drive the robot from the keyboard. `top/keyboard.py` does it."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.top.teleop import HELP as TELEOP_HELP

if TYPE_CHECKING:
    from acsard.top.keyboard import Ride
    from acsard.top.teleop import Teleop

PERIOD_S = 0.05

NEWS_S, SAME_S, QUIET_S = 0.5, 1.0, 10.0
"""Shortest time between two reports without a screen, s.

In this order, they apply after a change, while the robot moves, and while nothing happens.
"""

PART_S = 2.0
"""Time within which a robot usually stands after its own ramp, s."""

NO_END = 10**9

HELP = "\n".join(TELEOP_HELP)


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "drive",
        help="drive the robot with the keyboard",
        description="Drive the robot with the keyboard of this terminal. The tool uses the full "
        "screen, or prints line by line if the terminal cannot do that (TERM=dumb).\n\n" + HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, speed, unit in (("--linear", 0.5, "M/S"), ("--angular", 1.0, "RAD/S")):
        parser.add_argument(
            name,
            type=float,
            default=speed,
            metavar=unit,
            help="speed at the start, which keys change (default: %(default)s)",
        )
    parser.add_argument(
        "--source", default="teleop", help="command source to send as (default: teleop)"
    )
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C."""
    from acsard.client import connect
    from acsard.core.messages.permissions import COMMAND_ROLE, has
    from acsard.host.errors import NoAnswerError, NotPermittedError, UsageError
    from acsard.top.keyboard import Keyboard, Ride

    endpoint, robot_id, tls = robot_address(args)
    if not sys.stdin.isatty():
        raise UsageError(
            "drive reads single keys and needs a terminal; a program uses acsard.client"
        )
    with connect(endpoint, robot_id=robot_id, source=args.source, tls=tls) as robot:
        if tls and not has((us := robot.whoami()).role, COMMAND_ROLE):
            raise (NotPermittedError if us.role else NoAnswerError)(us.words())
        ride = Ride(robot, Keyboard(args.linear, args.angular), robot_id, endpoint)
        try:
            _show(ride)
        finally:
            ride.end()
        _part(ride)
    return 0


def _show(ride: Ride) -> None:
    """Run full-screen if the terminal can do it, else line by line."""
    from acsard.terminal.output import has_screen
    from acsard.top.terminal import drive

    if not has_screen():
        return _plain(ride)
    return drive(ride.step, ride.seen)


def _plain(ride: Ride) -> None:
    """Print some lines after each change, and at intervals."""
    from acsard.top.key_reader import keys, until_told
    from acsard.top.teleop import news

    due, page = News(), Page()
    with until_told(), keys() as read:
        while (typed := read(PERIOD_S)) is not None:
            ride.step(typed)
            seen = ride.seen()
            if due.tell(seen, time.monotonic()):
                print("\n".join(page.with_help(news(seen, _width()), _height())), flush=True)


def _part(ride: Ride) -> None:
    """Print a last report when the robot stands, or after `PART_S`.

    Without the wait, the last line would say that the robot drives although it stands a moment
    later.
    """
    from acsard.top.teleop import moves, parting

    left = time.monotonic()
    while os.isatty(0) and os.isatty(1):
        ride.take()
        seen, took = ride.seen(), time.monotonic() - left
        rests = seen.state is not None and seen.age < took and not moves(seen.state)
        if rests or took > PART_S:
            print("\n".join(parting(seen, _width())), flush=True)
            return
        time.sleep(PERIOD_S)


def _width() -> int:
    """Return the terminal's width in columns. A file's width is unlimited."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else NO_END


def _height() -> int:
    return shutil.get_terminal_size().lines if sys.stdout.isatty() else NO_END


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
        self._shown = len(TELEOP_HELP) + len(told)
        return [*TELEOP_HELP, *told]
