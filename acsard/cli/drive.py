"""`acsard drive`: the keyboard drives the robot, with teleop_twist_keyboard's keys.

A terminal tells when a key goes down but never when it is let go: each press drives for
`HOLD_S`, repeats extend it, and the end is three zeros and then silence.
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
"""Longer than a keyboard's delay before its first repeat (0.25 to 0.5 s), or it would stutter."""

ZEROS = 3
PERIOD_S = 0.05

OBJECTS_S = 0.5
"""A key that does not drive for so long is worth a word: the first 0.25 s never count."""

ASK_S = 0.5
"""Without a state for so long it is asked for: it may be published seldom."""

NEWS_S, SAME_S, QUIET_S = 0.5, 1.0, 10.0
"""Without a screen: news at most so often, while it moves, and while nothing happens."""

PART_S = 2.0
"""A robot stands within, by the ramp of its own."""

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
    """What the keys pressed so far ask of the robot; pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        self._until = 0.0
        self._zeros = ZEROS
        self._lead = False

    def press(self, key: str, now: float) -> None:
        """A key (or an arrow's escape sequence) was pressed at `now` s."""
        if key in _SPEEDS:
            self.linear *= _SPEEDS[key][0]
            self.angular *= _SPEEDS[key][1]
        elif key in _MOVES:
            # After a silence the robot may want neutral first (it was stopped and cleared, say).
            self._lead = self._lead or (now >= self._until and not self._zeros)
            self._move, self._until, self._zeros = _MOVES[key], now + HOLD_S, ZEROS
        else:
            # Like the tool people know: any other key stops.
            self._move, self._until, self._zeros = (0, 0), now, ZEROS

    def send(self, now: float) -> Twist | None:
        """The command to send at `now`, or None for silence."""
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
    """Declare the verb."""
    parser = verbs.add_parser(
        "drive",
        help="drive by keyboard",
        description="Drive by keyboard from this terminal, on a screen of its own (in colours with "
        "the extra `top`); line by line where TERM is dumb.\n\n" + HELP,
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
    """On a screen of its own where there is one."""
    dumb = os.environ.get("TERM", "dumb") in ("dumb", "unknown", "")
    if dumb or not sys.stdout.isatty():
        return _plain(ride)
    try:
        from acsard.top.terminal import drive
    except ImportError:  # no rich, and so no colours
        from acsard.top.bare import drive
    return drive(ride.step, ride.seen)


def _plain(ride: Ride) -> None:
    """Some lines when there is news, and now and then."""
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
    """The last word, to who is still there: not that it drives, when it stands a moment later."""
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
    """Of the terminal that is written to; of a file there is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else NO_END


def _height() -> int:
    return shutil.get_terminal_size().lines if sys.stdout.isatty() else NO_END


class News:
    """What is worth some lines where there is no screen; pure."""

    def __init__(self) -> None:
        self._shown: tuple[object, ...] = ()
        self._at = -QUIET_S

    def tell(self, seen: Seen, now: float) -> bool:
        """At `now` s it is."""
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
    """Where there is no screen, the help comes again before it is out of sight; pure."""

    def __init__(self) -> None:
        self._shown = NO_END
        """Lines since the help began."""

    def with_help(self, told: list[str], height: int) -> list[str]:
        """These lines, below the help where they are the first or would shove it out."""
        self._shown += len(told)
        if self._shown < height:
            return told
        self._shown = len(TELEOP_HELP) + len(told)
        return [*TELEOP_HELP, *told]


class Ride:
    """Between the keys and the robot."""

    def __init__(self, robot: Client, teleop: Teleop, robot_id: str, endpoint: str) -> None:
        from acsard.client.driving import Answers
        from acsard.messages.encodings import Decoder
        from acsard.messages.schema import RobotState

        self._robot, self._teleop = robot, teleop
        self._names = robot_id, endpoint
        self._decoder, self._states = Decoder(RobotState), robot.subscribe("state")
        self._answers: deque[zenoh.Sample] = deque()
        """Left here by a thread of Zenoh's."""
        self._answered = Answers()
        self._state: RobotState | None = None
        self._heard = self._fine = self._asked = time.monotonic()

    def step(self, typed: str) -> None:
        """These keys were pressed; send what is to be sent, take what has come."""
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
        """Take what has come; ask when nothing does."""
        while self._answers:  # first: what comes by itself is later
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

        with suppress(DecodeError):  # a stranger's
            state = self._decoder.decode(*encoded(sample))
            if asked and not self._answered.news(state, self._state):
                self._state = self._state or state  # the first may be a storage's: no news yet
                return
            self._state, self._heard = state, time.monotonic()

    def seen(self) -> Seen:
        """What there is to show."""
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
    """What one read of the terminal gave, as keys; an arrow is three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
