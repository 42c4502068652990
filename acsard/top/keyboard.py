"""Drives the robot from the keyboard with the keys of teleop_twist_keyboard.

A terminal never reports the release of a key, so each press drives for `KEY_HOLD_S`, and each
repeat of a held key for `REPEAT_S`. Then come zeros until the robot has stopped. Keys that were
typed during a pause of this program do not drive. If the robot stops following while a key is held,
this key drives again only after an undelayed key that stops the robot, or after 1.5 s without a
driving key. Otherwise it would drive after a `clear`.
"""

from __future__ import annotations

import math
import time

from acsard.client import Client
from acsard.client.commander import (
    GRACE_S,
    RELEASE_TIMEOUT_NS,
    ZEROS,
    Commander,
    Wish,
    can_drive,
    must_release_key,
    objection,
)
from acsard.client.driving import repeat_zeros
from acsard.client.final_zeros import FinalZeros
from acsard.client.follower import SETTLED_S, Watch, restarted
from acsard.core.values import NS_PER_S, REST, Twist
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
    """Converts key presses to velocity commands. Times are monotonic, s. The class is pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        # Last press of a driving key (minus infinity after a stop), and its repeats.
        self._pressed, self._repeats = -math.inf, 0
        # Of the present hold: driving keys at most `RELEASE_TIMEOUT_NS` apart. `end_hold` may have
        # ended it.
        self._begun, self._over = 0.0, False
        self._until = 0.0
        self._old_until = 0.0  # all keys count as delayed until then
        self._zeros = ZEROS

    def take(self, text: str, now: float, waited: float = 0.0) -> None:
        """Process the keys of one read, which have waited at most `waited` s.

        They count as delayed if they waited for longer than `GRACE_S`, or if more than
        `MAX_BURST_KEYS` come together. Delayed keys only stop the robot. After such a wait, an
        earlier press does not drive any more either.
        """
        # A delayed key that stops the robot does not let a held key drive again, because a stalled
        # connection may deliver this key first, and the keys that were typed after it only later.
        keys = split(text)
        if len(keys) > MAX_BURST_KEYS or waited > GRACE_S:
            self._old_until = now + BURST_S
        if now < self._old_until and (keys or now < self._until):
            if not self._over:
                self._stop(now)
            if keys:
                self._pressed = now  # a key may have been held all the time
            return
        for key in keys:
            self.press(key, now)

    def press(self, key: str, now: float) -> None:
        """Process one character, or the escape sequence of an arrow key."""
        if key in _SPEEDS:
            self.linear *= _SPEEDS[key][0]
            self.angular *= _SPEEDS[key][1]
        elif key in _MOVES:
            repeated = self._move == _MOVES[key] and now - self._pressed < REPEAT_S
            self._repeats = self._repeats + 1 if repeated else 0
            hold = REPEAT_S if self._repeats >= REPEATS else KEY_HOLD_S
            if not self._key_is_down(now):
                self._begun, self._over = now, False
            self._pressed = now
            if not self._over:
                self._move, self._until, self._zeros = _MOVES[key], now + hold, ZEROS
        else:
            # Any other key stops the robot, as in teleop_twist_keyboard.
            self._pressed, self._over = -math.inf, False
            self._stop(now)

    def end_hold(self, now: float) -> None:
        """Stop the robot, and ignore the held key, because the robot does not follow.

        Do nothing if the hold began less than `SETTLED_S` ago, because the state may be older. If
        no key seems held, the network may be delaying repeats: a later burst of them is ignored
        too.
        """
        key_down = self._key_is_down(now)
        if self._over or (key_down and now - self._begun <= SETTLED_S):
            return
        self._over = True
        if key_down:
            self._stop(now)

    def ignores(self, now: float) -> bool:
        """Return whether a key is held that is ignored because of `end_hold`."""
        return self._over and self._key_is_down(now)

    def _key_is_down(self, now: float) -> bool:
        return now - self._pressed <= RELEASE_TIMEOUT_NS / NS_PER_S

    def _stop(self, now: float) -> None:
        self._move, self._until, self._zeros = (0, 0), now, ZEROS

    def wish(self, now: float) -> Twist | None:
        """Return the command to send, or None. Each call consumes one of the final zeros."""
        if now < self._until:
            return Twist(self.linear * self._move[0], self.angular * self._move[1])
        if self._zeros:
            self._zeros -= 1
            return REST
        return None


class KeyboardDrive:
    """Sends the commands of the typed keys to the robot, and receives the robot's state."""

    def __init__(self, robot: Client, keyboard: Keyboard) -> None:
        self._robot, self._keyboard = robot, keyboard
        # After a silence the robot may require a return to neutral, for example because it was
        # stopped and cleared during the silence.
        self._commander = Commander(sends_leading_zero=True)
        self._final_zeros = FinalZeros(robot.source, robot.sender)
        self._watch = Watch(robot, clock.steady_s())
        # Subscribing may take long. The terminal discards the keys that are typed until it is done.
        self._fine = self._stepped = clock.steady_s()

    def step(self, typed: str) -> None:
        """Process the keys of one read, send the command that is due, and process the states."""
        now = clock.steady_s()
        now_ns = round(now * NS_PER_S)
        waited, self._stepped = now - self._stepped, now
        self._keyboard.take(typed, now, waited)
        wish = self._keyboard.wish(now)
        if wish is None and self._final_zeros.wanted(now):
            wish = REST
        if wish is not None:
            self._commander.take(Wish(wish), now_ns)
        # Send only one command per step. If a nonzero command followed a zero immediately, the
        # daemon could miss the zero.
        sent = self._commander.send(now_ns)
        if sent is not None:
            self._robot.send(sent.twist.linear, sent.twist.angular)
            if sent.twist != REST:
                self._final_zeros.drove(now)
        if (sent is None or sent.twist == REST) and not self._keyboard.ignores(now):
            self._fine = now
        self.take()

    def take(self) -> None:
        """Process the states that have arrived. If none has for some time, query it."""
        now, before = clock.steady_s(), self._watch.state
        for state in self._watch.poll(now):
            self._final_zeros.received(state, now)
            if must_release_key(state, self._robot.source) or restarted(before, state):
                self._keyboard.end_hold(now)
            before = state

    def end(self) -> None:
        """Send zeros until the robot has stopped, but for at most `MAX_END_S`.

        States are processed meanwhile, so the last report shows the robot as it is then.
        """
        if not self._final_zeros.wanted(clock.steady_s()):
            return
        for pause_s in repeat_zeros(self._robot):
            time.sleep(pause_s)
            self.take()

    def screen_data(self) -> Teleop:
        now, robot, watch = clock.steady_s(), self._robot, self._watch
        why = ""
        if watch.state is not None and now - self._fine > GRACE_S:
            why = objection(watch.state, robot.source, robot.sender)
            if self._keyboard.ignores(now) and can_drive(watch.state):
                why = RELEASE_REASON
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
    """Split the text of one read into keys. An arrow key has three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
