"""Encodes four wheel speeds as one plain line, and decodes such a line.

In `ap12.50,bn08.75,cp15.00,dn10.25`, a value is a motor letter, `p` (positive) or `n` (negative),
and a speed in rad/s. The decoder also accepts spaces after commas, a trailing comma, one or two
integer digits, and one to three decimals. One invalid value makes the line invalid. In the daemon,
only this module maps motor letters and signs to wheels.
"""

from __future__ import annotations

import math
import re
from typing import Literal

from acsard.core.config.settings import WheelMap
from acsard.core.values import STILL, AcsardError, Wheels4, WheelSpeeds

LETTERS = "abcd"

Motors = tuple[float, float, float, float]  # a value of each motor, a to d, with the board's sign

MAX_SPEED = 99.99  # rad/s, two digits before the point and two after it

RejectReason = Literal[
    "malformed", "duplicate_wheel", "over_range", "without_crc", "crc_error", "stale_sequence",
    "repeated",
    "status_malformed", "status_without_crc", "status_crc_error",
]  # fmt: skip

_TOKEN = rb"([abcd][pn])([0-9]{1,2}\.[0-9]{1,3})"
TOKENS = _TOKEN + (rb", *" + _TOKEN) * 3  # the four values, without a trailing comma
_LINE = re.compile(TOKENS + rb"(?:, *)?")


class FrameError(AcsardError):
    """An invalid line from the board; `reason` is the kind of error, such as "crc_error"."""

    def __init__(self, reason: RejectReason, line: bytes) -> None:
        super().__init__(reason, line)
        self.reason = reason

    def __str__(self) -> str:
        # Format only when the message is shown: a noisy wire raises hundreds of these in one step.
        reason, line = self.args
        return f"{reason}: {line[:60]!r}"


class Codec:
    """Plain lines for one assignment of the motors to the wheels."""

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
        self.stop = self._written(STILL)  # zero for all wheels, with line end
        self._last = (STILL, self.stop)

    def encode(self, speeds: WheelSpeeds) -> bytes:
        """Return the line, with its end, for speeds clamped to 99.99 and rounded to 0.01 rad/s.

        Raises `ValueError` for a speed that is not finite, because that is a bug of the caller.
        """
        last, line = self._last
        if speeds != last:  # a steady command repeats its line in each period
            line = self._written(speeds)
            self._last = (speeds, line)
        return line

    def _written(self, speeds: WheelSpeeds) -> bytes:
        wheel = speeds.as_tuple()
        tokens = [_token(letter, sign * wheel[index]) for letter, index, sign in self._wiring]
        return ",".join(tokens).encode() + self._end

    def wheels(self, motors: Motors) -> Wheels4:
        """Return values of the motors a to d as values of the wheels, forward positive."""
        wheel = [0.0] * 4
        for motor, (_, index, sign) in zip(motors, self._wiring, strict=True):
            wheel[index] = motor * sign
        front_right, front_left, rear_left, rear_right = wheel
        return front_right, front_left, rear_left, rear_right

    def decode(self, line: bytes) -> WheelSpeeds:
        """Return the wheel speeds in a plain line without its end. Raises `FrameError`."""
        match = _LINE.fullmatch(line)
        if match is None:
            raise FrameError("malformed", line)
        a, of_a, b, of_b, c, of_c, d, of_d = match.groups()
        places, wheel = self._by_word, [math.inf] * 4
        index, sign = places[a]
        wheel[index] = sign * float(of_a)
        index, sign = places[b]
        wheel[index] = sign * float(of_b)
        index, sign = places[c]
        wheel[index] = sign * float(of_c)
        index, sign = places[d]
        wheel[index] = sign * float(of_d)
        if max(wheel) > MAX_SPEED or min(wheel) < -MAX_SPEED:
            raise FrameError("duplicate_wheel" if math.inf in wheel else "over_range", line)
        front_right, front_left, rear_left, rear_right = wheel
        return WheelSpeeds(front_right, front_left, rear_left, rear_right)


def _token(letter: str, speed: float) -> str:
    # Round to whole hundredths before formatting: 9.999 must become 10.00 and not 010.00, and a
    # negative speed that rounds to zero must become p00.00 and not n00.00.
    if not math.isfinite(speed):
        raise ValueError(f"wheel speed {speed} is not finite")
    hundredths = int(min(abs(speed), MAX_SPEED) * 100 + 0.5)
    direction = "n" if speed < 0 and hundredths else "p"
    return f"{letter}{direction}{hundredths // 100:02d}.{hundredths % 100:02d}"
