"""One line <-> four wheel speeds: the MCU's plain protocol and its dialects.

`ap12.50,bn08.75,cp15.00,dn10.25`: motor letter, `p` or `n` for the direction, rad/s. Writing is
exact to the byte; reading is strict about meaning and lenient about form (spaces after commas, a
trailing comma, one or two integer digits, one to three decimals). A line counts whole or not at
all. The letters' wheels and signs are applied here and nowhere else.
"""

from __future__ import annotations

import math
import re
from typing import Literal

from acsard.config.settings import WheelMap
from acsard.values import STILL, AcsardError, WheelSpeeds

LETTERS = "abcd"

Motors = tuple[float, float, float, float]

MAX_SPEED = 99.99
"""rad/s; what two integer digits and two decimals can say."""

Reason = Literal[
    "malformed", "wheel_twice", "over_range", "unchecked", "wrong_check", "stale_sequence"
]

_TOKEN = rb"([abcd][pn])([0-9]{1,2}\.[0-9]{1,3})"
TOKENS = _TOKEN + (rb", *" + _TOKEN) * 3
"""The four values of a line, as an expression."""
_LINE = re.compile(TOKENS + rb"(?:, *)?")


class FrameError(AcsardError):
    """A line is not a frame; `reason` is the name it is counted under."""

    def __init__(self, reason: Reason, line: bytes) -> None:
        super().__init__(reason, line)
        self.reason = reason

    def __str__(self) -> str:
        # Formatted only when it is shown: a noisy wire raises hundreds of these in one step.
        reason, line = self.args
        return f"{reason}: {line[:60]!r}"


class Codec:
    """Encodes and decodes lines for one wiring and one dialect."""

    _last_read: tuple[bytes | None, WheelSpeeds] = (None, STILL)
    """The last line that was decoded, and its speeds."""

    def __init__(self, wheels: WheelMap, trailing_comma: bool = False) -> None:
        motors = (wheels.front_right, wheels.front_left, wheels.rear_left, wheels.rear_right)
        place = {motor[1]: index for index, motor in enumerate(motors)}
        self._wiring = tuple(
            (letter, place[letter], -1.0 if motors[place[letter]][0] == "-" else 1.0)
            for letter in LETTERS
        )
        self._by_word = {
            letter.encode() + direction: (index, sign * way)
            for letter, index, sign in self._wiring
            for direction, way in ((b"p", 1.0), (b"n", -1.0))
        }
        self._end = b",\r\n" if trailing_comma else b"\r\n"
        self.stop = self._written(STILL)
        """The line that says zero on all wheels."""
        self._last = (STILL, self.stop)

    def encode(self, speeds: WheelSpeeds) -> bytes:
        """The command line for these speeds, magnitudes clamped to 99.99 and rounded to 0.01.

        Raises ValueError for a speed that is not finite: the caller has a bug.
        """
        last, line = self._last
        if speeds != last:  # a steady command says the same in each period
            line = self._written(speeds)
            self._last = (speeds, line)
        return line

    def _written(self, speeds: WheelSpeeds) -> bytes:
        wheel = speeds.as_tuple()
        tokens = [_token(letter, sign * wheel[index]) for letter, index, sign in self._wiring]
        return ",".join(tokens).encode() + self._end

    def wheels(self, motors: Motors) -> Motors:
        """What the motors a to d did, as what the wheels did: in `WHEELS` order, forward is +."""
        wheel = [0.0] * 4
        for motor, (_, index, sign) in zip(motors, self._wiring, strict=True):
            wheel[index] = motor * sign
        front_right, front_left, rear_left, rear_right = wheel
        return front_right, front_left, rear_left, rear_right

    def decode(self, line: bytes) -> WheelSpeeds:
        """The speeds a line without its end says; raises `FrameError` unless all of it is right."""
        last, speeds = self._last_read
        if line == last:  # a robot at rest says the same in each period
            return speeds
        match = _LINE.fullmatch(line)
        if match is None:
            raise FrameError("malformed", line)
        wheel: list[float | None] = [None] * 4
        a, of_a, b, of_b, c, of_c, d, of_d = match.groups()
        places = self._by_word
        for word, digits in (a, of_a), (b, of_b), (c, of_c), (d, of_d):
            index, sign = places[word]
            speed = float(digits)
            if speed > MAX_SPEED:
                raise FrameError("over_range", line)
            wheel[index] = speed * sign
        front_right, front_left, rear_left, rear_right = wheel
        if front_right is None or front_left is None or rear_left is None or rear_right is None:
            raise FrameError("wheel_twice", line)
        speeds = WheelSpeeds(front_right, front_left, rear_left, rear_right)
        self._last_read = line, speeds
        return speeds


def _token(letter: str, speed: float) -> str:
    # Rounding in whole hundredths first: 9.999 must become 10.00, never 010.00, and a speed that
    # rounds to nothing is p00.00, never n00.00.
    if not math.isfinite(speed):
        raise ValueError(f"wheel speed {speed} is not finite")
    hundredths = int(min(abs(speed), MAX_SPEED) * 100 + 0.5)
    direction = "n" if speed < 0 and hundredths else "p"
    return f"{letter}{direction}{hundredths // 100:02d}.{hundredths % 100:02d}"
