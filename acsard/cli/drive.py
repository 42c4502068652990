"""`acsard drive`: drive the robot from the keyboard with the keys of teleop_twist_keyboard.

A terminal reports a key press but never its release. Each press therefore drives for `HOLD_S`, and
key repeats extend it. After that the tool sends three zeros and then nothing.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.top.teleop import HELP as TELEOP_HELP
from acsard.values import REST, Twist

if TYPE_CHECKING:
    import zenoh

    from acsard.client import Client
    from acsard.messages.schema import RobotState
    from acsard.top.teleop import Teleop as Seen

HOLD_S = 0.6
"""Time that one key press drives, s.

It is longer than a keyboard's delay before the first repeat (0.25 to 0.5 s); otherwise the robot
would stutter.
"""

ZEROS = 3
PERIOD_S = 0.05

OBJECTS_S = 0.5
"""Time for which keys have no effect before the reason is shown, s.

The daemon ignores the first 0.25 s (one timeout of the source) of every new sender.
"""

ASK_S = 0.5
"""Silence on `state` after which it is queried, s.

A robot may be configured to publish it rarely.
"""

NEWS_S, SAME_S, QUIET_S = 0.5, 1.0, 10.0
"""Shortest time between two reports without a screen, s.

In this order, they apply after a change, while the robot moves, and while nothing happens.
"""

PART_S = 2.0
"""Time within which a robot usually stands after its own ramp, s."""

NO_END = 10**9

_MOVES = {
    "i": (1, 0), "o": (1, -1), "u": (1, 1), "j": (0, 1), "l": (0, -1),
    ",": (-1, 0), ".": (-1, 1), "m": (-1, -1),
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
}  # fmt: skip
_SPEEDS = {
    "q": (1.1, 1.1), "z": (0.9, 0.9), "w": (1.1, 1.0), "x": (0.9, 1.0),
    "e": (1.0, 1.1), "c": (1.0, 0.9),
}  # fmt: skip

HELP = "\n".join(TELEOP_HELP)


class Teleop:
    """The command that the keys pressed so far ask for. The class is pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        self._until = 0.0
        self._zeros = ZEROS
        self._lead = False

    def press(self, key: str, now: float) -> None:
        """Handle a key, or an arrow's escape sequence, that was pressed at `now` s."""
        if key in _SPEEDS:
            self.linear *= _SPEEDS[key][0]
            self.angular *= _SPEEDS[key][1]
        elif key in _MOVES:
            # Send a zero first after a silence: the robot may require a return to neutral, for
            # example because it was stopped and cleared meanwhile.
            self._lead = self._lead or (now >= self._until and not self._zeros)
            self._move, self._until, self._zeros = _MOVES[key], now + HOLD_S, ZEROS
        else:
            # Any other key stops the robot, as in teleop_twist_keyboard.
            self._move, self._until, self._zeros = (0, 0), now, ZEROS

    def send(self, now: float) -> Twist | None:
        """Return the command to send at `now` s, or None if nothing is to be sent."""
        if self._lead:
            self._lead = False
            return REST
        if now < self._until:
            return Twist(self.linear * self._move[0], self.angular * self._move[1])
        if self._zeros:
            self._zeros -= 1
            return REST
        return None


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "drive",
        help="drive by keyboard",
        description="Drive by keyboard from this terminal, on a screen of its own; line "
        "by line where TERM is dumb.\n\n" + HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--linear", type=float, default=0.5, metavar="M/S", help="default 0.5")
    parser.add_argument("--angular", type=float, default=1.0, metavar="RAD/S", help="default 1.0")
    parser.add_argument("--source", default="teleop", help="command as this source, default teleop")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C."""
    from acsard.client import connect
    from acsard.host.errors import NoAnswerError, NotPermittedError, UsageError

    endpoint, robot_id, tls = robot_address(args)
    if not sys.stdin.isatty():
        raise UsageError("drive reads keys and needs a terminal; use acsard.client")
    with connect(endpoint, robot_id=robot_id, source=args.source, tls=tls) as robot:
        if tls and (us := robot.whoami()).role in ("", "viewer"):
            raise (NotPermittedError if us.role else NoAnswerError)(us.words())
        ride = Ride(robot, Teleop(args.linear, args.angular), robot_id, endpoint)
        try:
            _show(ride)
        finally:
            for _ in range(ZEROS):
                robot.send(0.0, 0.0)
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
    from acsard.top.keys import keys, until_told
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

    def tell(self, seen: Seen, now: float) -> bool:
        """Return whether a report is due at `now` s, and remember it as printed."""
        from acsard.top.teleop import SILENT_S

        state = seen.state
        words = ("", "") if state is None else (state.mode, state.reason)
        what = (*words, seen.objection, seen.linear, seen.angular, seen.age > SILENT_S)
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


class Ride:
    """The connection between the keys and the robot: sends commands and receives `state`."""

    def __init__(self, robot: Client, teleop: Teleop, robot_id: str, endpoint: str) -> None:
        from acsard.client.driving import Answers
        from acsard.messages.encodings import Decoder
        from acsard.messages.schema import RobotState

        self._robot, self._teleop = robot, teleop
        self._names = robot_id, endpoint
        self._decoder, self._states = Decoder(RobotState), robot.subscribe("state")
        self._answers: deque[zenoh.Sample] = deque()
        """Answers to queries, appended by a thread of Zenoh."""
        self._answered = Answers()
        self._state: RobotState | None = None
        self._heard = self._fine = self._asked = time.monotonic()

    def step(self, typed: str) -> None:
        """Handle these key presses, send the command that is due, and take new messages."""
        now = time.monotonic()
        for key in split(typed):
            self._teleop.press(key, now)
        wish = self._teleop.send(now)
        if wish is not None:
            self._robot.send(wish.linear, wish.angular)
        if wish in (None, REST):
            self._fine = now
        self.take()

    def take(self) -> None:
        """Take the messages that have arrived, and query `state` if it is silent."""
        while self._answers:  # answers first: a message that the robot published by itself is newer
            self._take(self._answers.popleft(), asked=True)
        while (sample := self._states.try_recv()) is not None:
            self._take(sample, asked=False)
        now = time.monotonic()
        if now - max(self._heard, self._asked) > ASK_S:
            self._asked = now
            self._robot.ask("state", self._answers.append)

    def _take(self, sample: zenoh.Sample, asked: bool) -> None:
        from acsard.bus.subscription import encoded
        from acsard.messages.encodings import DecodeError

        with suppress(DecodeError):  # the message of another program on this key cannot be decoded
            state = self._decoder.decode(*encoded(sample))
            if asked and not self._answered.news(state, self._state):
                # The first answer may be a storage's, which does not prove that the robot lives.
                self._state = self._state or state
                return
            self._state, self._heard = state, time.monotonic()

    def seen(self) -> Seen:
        """Return the values to show now."""
        from acsard.client.driving import objection
        from acsard.top.teleop import Teleop as Seen

        now, state, robot = time.monotonic(), self._state, self._robot
        why = ""
        if state is not None and now - self._fine > OBJECTS_S:
            why = objection(state, robot.source, robot.sender)
        speeds = self._teleop.linear, self._teleop.angular
        return Seen(
            self._names[0], self._names[1], robot.source, *speeds, state, now - self._heard, why
        )


def split(text: str) -> list[str]:
    """Split the text of one terminal read into keys. An arrow key is three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
