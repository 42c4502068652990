"""`acsard drive`: the keyboard drives the robot, with teleop_twist_keyboard's keys.

A terminal tells when a key goes down but never when it is let go: each press drives for
`HOLD_S`, repeats extend it, and the end is three zeros and then silence.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.values import REST, Twist

if TYPE_CHECKING:
    from acsard.client import Client

HOLD_S = 0.6
"""Longer than a keyboard's delay before its first repeat (0.25 to 0.5 s), or it would stutter."""

ZEROS = 3
SILENT_S = 1.0
PERIOD_S = 0.05

_MOVES = {
    "i": (1, 0), "o": (1, -1), "u": (1, 1), "j": (0, 1), "l": (0, -1),
    ",": (-1, 0), ".": (-1, 1), "m": (-1, -1),
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
}  # fmt: skip
_SPEEDS = {
    "q": (1.1, 1.1), "z": (0.9, 0.9), "w": (1.1, 1.0), "x": (0.9, 1.0),
    "e": (1.0, 1.1), "c": (1.0, 0.9),
}  # fmt: skip

HELP = """\
   u    i    o       q/z  both speeds +/- 10 %
   j    k    l       w/x  linear only    e/c  angular only
   m    ,    .       arrows drive too; space or k stops; Ctrl-C leaves
"""


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
        description="Drive by keyboard from this terminal.\n\n" + HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--linear", type=float, default=0.5, metavar="M/S", help="default 0.5")
    parser.add_argument("--angular", type=float, default=1.0, metavar="RAD/S", help="default 1.0")
    parser.add_argument("--source", default="teleop", help="command as this source, default teleop")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C."""
    import signal
    import termios
    import tty

    from acsard.client import connect
    from acsard.host.errors import UsageError

    if not sys.stdin.isatty():
        raise UsageError("drive reads keys and needs a terminal; use acsard.client")
    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, source=args.source, tls=tls) as robot:
        print(HELP)
        before = termios.tcgetattr(sys.stdin)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.default_int_handler)  # leave as by Ctrl-C
        tty.setcbreak(sys.stdin)
        try:
            _loop(robot, Teleop(args.linear, args.angular))
        except KeyboardInterrupt:
            pass
        finally:
            for _ in range(ZEROS):
                robot.send(0.0, 0.0)
            try:
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
                print()
            except (OSError, termios.error):
                pass  # the terminal has been closed
    return 0


def _loop(robot: Client, teleop: Teleop) -> None:
    import os
    import select
    import time

    from acsard.bus.subscription import encoded
    from acsard.messages.encodings import Decoder
    from acsard.messages.schema import RobotState

    decoder, states = Decoder(RobotState), robot.subscribe("state")
    shown, heard = "", time.monotonic()
    while True:
        ready, _, _ = select.select([sys.stdin], [], [], PERIOD_S)
        if ready:
            for key in split(os.read(sys.stdin.fileno(), 64).decode(errors="replace")):
                teleop.press(key, time.monotonic())
        wish = teleop.send(time.monotonic())
        if wish is not None:
            robot.send(wish.linear, wish.angular)
        while (sample := states.try_recv()) is not None:
            heard = time.monotonic()
            state = decoder.decode(*encoded(sample))
            shown = f"x {state.x:7.2f}  y {state.y:7.2f}  yaw {state.yaw:6.2f}  {state.reason}"
        if time.monotonic() - heard > SILENT_S:
            shown = "no word from the daemon"
        line = f"{teleop.linear:.2f} m/s {teleop.angular:.2f} rad/s   {shown}"
        print(f"\r{line[:118]:<118}", end="", flush=True)


def split(text: str) -> list[str]:
    """What one read of the terminal gave, as keys; an arrow is three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
