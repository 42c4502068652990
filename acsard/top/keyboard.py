"""Drives the robot from the keyboard with the keys of teleop_twist_keyboard.

A terminal reports a key press but never its release. Each press therefore drives for `HOLD_S`, and
key repeats extend it. After that the tool sends three zeros and then nothing.
"""

from __future__ import annotations

import time

from acsard.client import Client
from acsard.client.commander import GRACE_S, ZEROS, Commander, Wish, objection
from acsard.client.follower import Watch
from acsard.core.values import NS_PER_S, REST, Twist
from acsard.top.teleop import Teleop

HOLD_S = 0.6
"""Time that one key press drives, s.

It is longer than a keyboard's delay before the first repeat (0.25 to 0.5 s); otherwise the robot
would stutter.
"""

_MOVES = {
    "i": (1, 0), "o": (1, -1), "u": (1, 1), "j": (0, 1), "l": (0, -1),
    ",": (-1, 0), ".": (-1, 1), "m": (-1, -1),
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
}  # fmt: skip
_SPEEDS = {
    "q": (1.1, 1.1), "z": (0.9, 0.9), "w": (1.1, 1.0), "x": (0.9, 1.0),
    "e": (1.0, 1.1), "c": (1.0, 0.9),
}  # fmt: skip


class Keyboard:
    """The command that the keys pressed so far ask for. The class is pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        self._until = 0.0
        self._zeros = ZEROS

    def press(self, key: str, now: float) -> None:
        """Handle a key, or an arrow's escape sequence, that was pressed at `now` s."""
        if key in _SPEEDS:
            self.linear *= _SPEEDS[key][0]
            self.angular *= _SPEEDS[key][1]
        elif key in _MOVES:
            self._move, self._until, self._zeros = _MOVES[key], now + HOLD_S, ZEROS
        else:
            # Any other key stops the robot, as in teleop_twist_keyboard.
            self._move, self._until, self._zeros = (0, 0), now, ZEROS

    def wish(self, now: float) -> Twist | None:
        """Return the command for the keys pressed until `now` s, or None to send nothing."""
        if now < self._until:
            return Twist(self.linear * self._move[0], self.angular * self._move[1])
        if self._zeros:
            self._zeros -= 1
            return REST
        return None


class Ride:
    """The connection between the keys and the robot: sends commands and follows `state`."""

    def __init__(self, robot: Client, keyboard: Keyboard) -> None:
        self._robot, self._keyboard = robot, keyboard
        # After a silence the robot may require a return to neutral, for example because it was
        # stopped and cleared meanwhile.
        self._commander = Commander(leads=True)
        self._fine = time.monotonic()
        self._watch = Watch(robot, self._fine)

    def step(self, typed: str) -> None:
        """Handle these key presses, send the command that is due, and take new messages."""
        now = time.monotonic()
        now_ns = round(now * NS_PER_S)
        for key in split(typed):
            self._keyboard.press(key, now)
        wish = self._keyboard.wish(now)
        if wish is not None:
            self._commander.take(Wish(wish), now_ns)
        # One command a step: the daemon may overlook a zero with a speed directly behind it.
        sent = self._commander.send(now_ns)
        if sent is not None:
            self._robot.send(sent.twist.linear, sent.twist.angular)
        if sent is None or sent.twist == REST:
            self._fine = now
        self.take()

    def take(self) -> None:
        """Take the messages that have arrived, and query `state` if it is late."""
        self._watch.look(time.monotonic())

    def end(self) -> None:
        """Send the last zeros."""
        for _ in range(ZEROS):
            self._robot.send(0.0, 0.0)

    def seen(self) -> Teleop:
        """Return the values to show now."""
        now, robot, watch = time.monotonic(), self._robot, self._watch
        why = ""
        if watch.state is not None and now - self._fine > GRACE_S:
            why = objection(watch.state, robot.source, robot.sender)
        return Teleop(
            robot.where.robot_id,
            robot.where.endpoint,
            robot.source,
            self._keyboard.linear,
            self._keyboard.angular,
            watch.state,
            watch.age(now),
            why,
            watch.silent(now),
        )


def split(text: str) -> list[str]:
    """Split the text of one terminal read into keys. An arrow key is three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
