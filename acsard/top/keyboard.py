"""Drives the robot from the keyboard with the keys of teleop_twist_keyboard.

A terminal reports a key press but never its release. Each press therefore drives the robot for
`KEY_HOLD_S`. From the third repeat (`REPEATS`) of a held key on, each repeat drives the robot
for `REPEAT_S` only. When this time is over, `acsard drive` sends at least three zero commands, and
more until the robot's state shows that the robot has stopped. Then it sends nothing. If this
program was paused for more than 0.5 s, the keys that the operator typed during the pause do not
drive the robot.

A key that was held when the robot was stopped must not drive the robot after `acsard call clear`.
This also holds if an SSH connection pauses, so that the key seems to be released. So if the robot
stops following while a key is held, this key no longer drives the robot. Driving keys work again
in two cases: a key that stops the robot arrives without delay, or no driving key arrives for 1.5 s.
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

KEY_HOLD_S = 0.6
"""Time for which one key press drives the robot, s.

This time must be longer than a keyboard's delay before the first repeat (0.25 to 0.5 s).
"""

REPEAT_S, REPEATS = 0.25, 3
"""Time for which a repeat of a held key drives the robot, s (`REPEAT_S`), and number of repeats
after which a key counts as held (`REPEATS`).

Presses of the same key count as repeats if they are less than `REPEAT_S` apart. Keyboards repeat a
key 10 to 30 times a second.
"""

MAX_BURST_KEYS = 8
"""Largest number of keys that may arrive together and still drive the robot.

If more keys arrive together, something has delayed them, usually a stalled SSH connection. The
operator may have released the key long ago.
"""

BURST_S = 0.2
"""Time after the arrival of delayed keys, s, in which all further keys count as delayed too,
because one read from the terminal may not return all delayed keys."""

RELEASE_REASON = (
    "the robot did not follow this program while you held the key, so the key is ignored: press "
    "space, then press the key again"
)
"""Text for the operator if a held key does not drive the robot although the robot could follow."""

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
    """Converts key presses to velocity commands. The class is pure."""

    def __init__(self, linear: float, angular: float) -> None:
        self.linear, self.angular = linear, angular
        self._move = (0, 0)
        self._pressed, self._repeats = -math.inf, 0
        """Monotonic time of the last press of a driving key, s, and number of repeats of this key.
        After a key that stops the robot, the time is minus infinity."""
        self._begun, self._over = 0.0, False
        """Monotonic time at which the present hold began, s, and whether `end_hold` has ended this
        hold. A hold is a series of driving keys that are at most `RELEASE_TIMEOUT_NS` apart."""
        self._until = 0.0
        self._old_until = 0.0
        """Monotonic time until which all keys count as delayed and only stop the robot, s."""
        self._zeros = ZEROS

    def take(self, text: str, now: float, waited: float = 0.0) -> None:
        """Process the keys of one read from the terminal.

        `text` contains the keys, and `now` is the time of the read (monotonic clock, s). `waited`
        is the time since the previous read, s, for which the keys may have waited. The keys count
        as delayed if `waited` is above `GRACE_S`, or if more than `MAX_BURST_KEYS` keys arrive
        together. Delayed keys do not show what the operator wants now, so they only stop the robot.
        If `waited` is above `GRACE_S`, an earlier press does not drive the robot any more either.
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
        """Process a key that was pressed at `now` (monotonic clock, s).

        `key` is one character, or the escape sequence of an arrow key.
        """
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
        """Stop the robot, and ignore the key that is held at `now` (monotonic clock, s).

        Call this when a state shows that the robot does not follow. There are two special cases:

        - The operator began to hold the key less than `SETTLED_S` ago. Then do nothing, because the
          state may be older than the key press.
        - No key seems to be held. Then the network may be delaying the repeats of a held key. If
          more than `MAX_BURST_KEYS` repeats arrive together later, ignore this key too.
        """
        key_down = self._key_is_down(now)
        if self._over or (key_down and now - self._begun <= SETTLED_S):
            return
        self._over = True
        if key_down:
            self._stop(now)

    def ignores(self, now: float) -> bool:
        """Return whether the operator holds a key that is ignored because of `end_hold`.

        `now` is the present time on the monotonic clock, s.
        """
        return self._over and self._key_is_down(now)

    def _key_is_down(self, now: float) -> bool:
        return now - self._pressed <= RELEASE_TIMEOUT_NS / NS_PER_S

    def _stop(self, now: float) -> None:
        self._move, self._until, self._zeros = (0, 0), now, ZEROS

    def wish(self, now: float) -> Twist | None:
        """Return the command to send at `now` (monotonic clock, s), or None to send nothing.

        Each call that returns a final zero reduces the number of zeros that are still to be sent.
        """
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
        """Process the typed keys, send the command that is due, and process the received states.

        `typed` contains the keys of one read from the terminal; "" if no key was typed.
        """
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
        """Process the states that have arrived. If no state has arrived for some time, query it."""
        now, before = clock.steady_s(), self._watch.state
        for state in self._watch.poll(now):
            self._final_zeros.received(state, now)
            if must_release_key(state, self._robot.source) or restarted(before, state):
                self._keyboard.end_hold(now)
            before = state

    def end(self) -> None:
        """Send zero commands until the robot has stopped, but for at most `MAX_END_S`.

        The states that arrive meanwhile are processed, so that the last report shows the robot as
        it is then.
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
    """Split the text of one read from the terminal into keys. An arrow key has three characters."""
    keys, at = [], 0
    while at < len(text):
        size = 3 if text.startswith("\x1b[", at) else 1
        keys.append(text[at : at + size])
        at += size
    return keys
