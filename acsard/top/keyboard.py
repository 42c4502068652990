"""Drives the robot from the keyboard with the keys of teleop_twist_keyboard.

A terminal never reports the release of a key, so each press drives for `KEY_HOLD_S`, and each
repeat of a held key for `REPEAT_S`. Keys that were typed during a pause of this program do not
drive. If the robot stops following while a key is held, the `Ride` has ended: the key drives again
only after an undelayed key that stops the robot, or after 1.5 s without a driving key.
"""

from __future__ import annotations

import time

from acsard.client.connection import Connection
from acsard.client.driving import Driver
from acsard.client.ride import GRACE_S, refuses_for_good
from acsard.core.values import REST, Twist
from acsard.host import clock
from acsard.top.drive_screen import Teleop

# One press drives for this time: longer than a keyboard's delay before the first repeat (0.25 to
# 0.5 s).
KEY_HOLD_S = 0.6

# A repeat drives for this time, and after so many a key counts as held. Keyboards repeat a key 10
# to 30 times a second.
REPEAT_S, REPEATS = 0.25, 3

# More keys at once were delayed, usually by a stalled SSH connection, and may have been released.
MAX_BURST_KEYS = 8

# After delayed keys, all further ones count as delayed too: one read may not return all.
BURST_S = 0.2

# Shown if a held key does not drive although the robot could follow.
RELEASE_REASON = (
    "the robot did not follow this program while you held the key, so the key is ignored: press "
    "space, then press the key again"
)

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
    """Converts key presses to wishes. Times are monotonic, s. The class is pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        self._pressed, self._repeats = 0.0, 0  # last press of a driving key, and its repeats
        self._until = 0.0
        self._old_until = 0.0  # all keys count as delayed until then
        self._lets_go = False

    def take(self, text: str, now: float, waited: float = 0.0) -> bool:
        """Process the keys of one read, and return whether they are delayed.

        They have waited at most `waited` s. They count as delayed if they waited for longer than
        `GRACE_S`, or if more than `MAX_BURST_KEYS` come together. Delayed keys only stop the robot.
        After such a wait, an earlier press does not drive any more either.
        """
        # A delayed key that stops the robot does not let a held key drive again, because a stalled
        # connection may deliver this key first, and the keys that were typed after it only later.
        keys = split(text)
        if len(keys) > MAX_BURST_KEYS or waited > GRACE_S:
            self._old_until = now + BURST_S
        if now < self._old_until:
            self._until = now
            return bool(keys)
        for key in keys:
            self.press(key, now)
        return False

    def press(self, key: str, now: float) -> None:
        """Process one character, or the escape sequence of an arrow key."""
        if key in _SPEEDS:
            self.linear *= _SPEEDS[key][0]
            self.angular *= _SPEEDS[key][1]
        elif key in _MOVES:
            repeated = self._move == _MOVES[key] and now - self._pressed < REPEAT_S
            self._repeats = self._repeats + 1 if repeated else 0
            self._move, self._pressed, self._lets_go = _MOVES[key], now, False
            self._until = now + (REPEAT_S if self._repeats >= REPEATS else KEY_HOLD_S)
        else:
            # Any other key stops the robot, as in teleop_twist_keyboard.
            self._move, self._until, self._lets_go = (0, 0), now, True

    def wish(self, now: float) -> Twist | None:
        """Return the speed of a held key, once a zero after a key that stops, or None."""
        if now < self._until:
            return Twist(self.linear * self._move[0], self.angular * self._move[1])
        lets_go, self._lets_go = self._lets_go, False
        return REST if lets_go else None


class KeyboardDrive:
    """Sends the commands of the typed keys to the robot, and receives the robot's state."""

    def __init__(self, robot: Connection, keyboard: Keyboard, limits: str = "") -> None:
        self._robot, self._keyboard, self._limits = robot, keyboard, limits
        self._driver = Driver(robot)
        # Subscribing may take long. The terminal discards the keys that are typed until it is done.
        self._fine = self._stepped = clock.steady_s()

    def step(self, typed: str) -> None:
        """Process the keys of one read, send the command that is due, and process the states."""
        now, ride = clock.steady_s(), self._driver.ride
        waited, self._stepped = now - self._stepped, now
        if self._keyboard.take(typed, now, waited):
            ride.hold(now)
        wish = self._keyboard.wish(now)
        self._driver.step(wish)
        if wish in (None, REST):
            self._fine = now

    def take(self) -> None:
        """Process the states that have arrived. If none has for some time, query it."""
        self._driver.take()

    def end(self) -> None:
        """Send zeros until the robot has stopped, but for at most `MAX_END_S`.

        States are processed meanwhile, so the last report shows the robot as it is then.
        """
        for pause_s in self._driver.zeros():
            time.sleep(pause_s)

    def screen_data(self) -> Teleop:
        now, robot, watch, ride = (
            clock.steady_s(),
            self._robot,
            self._driver.watch,
            self._driver.ride,
        )
        why, state = "", watch.state
        if state is not None and now - self._fine > GRACE_S:
            why = ride.objection or ""
            may_follow = state.mode != "waiting" and not refuses_for_good(state, robot.source)
            if ride.ended and may_follow:
                why = RELEASE_REASON
        return Teleop(
            robot.where.robot_id,
            robot.where.endpoint,
            robot.source,
            self._keyboard.linear,
            self._keyboard.angular,
            state,
            watch.age(now),
            why,
            watch.silent(now),
            self._limits,
        )


def split(text: str) -> list[str]:
    """Split the text of one read into keys. An arrow key has three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
