"""Encodes the wheel speeds as one plain line, and decodes such a line.

In `ap12.50,bn08.75,cp15.00,dn10.25`, a value is a motor letter, `p` (positive) or `n` (negative),
and a speed in rad/s. The letters are declared, four of them or two. The decoder also accepts spaces
after commas, a trailing comma, one or two integer digits, one to three decimals, and any order of
the letters. One invalid value makes the line invalid. In the daemon, only this module maps motor
letters and signs to wheels: above it, two driven wheels are four, of which the rear ones do as the
front ones do.
"""

from __future__ import annotations

import math
import re
from typing import Literal

from acsard.core.config.settings import WheelMap
from acsard.core.values import STILL, AcsardError, Wheels4, WheelSpeeds

Motors = tuple[float, ...]  # a value of each motor, by letter, with the board's sign

MAX_SPEED = 99.99  # rad/s, two digits before the point and two after it

RejectReason = Literal[
    "malformed", "duplicate_wheel", "over_range", "without_crc", "crc_error", "stale_sequence",
    "repeated",
    "status_malformed", "status_without_crc", "status_crc_error",
]  # fmt: skip

SPEED = rb"[0-9]{1,2}\.[0-9]{1,3}"


class FrameError(AcsardError):
    """An invalid line from the board; `reason` is the kind of error, such as "crc_error"."""

    def __init__(self, reason: RejectReason, line: bytes) -> None:
        super().__init__(reason, line)
        self.reason = reason

    def __str__(self) -> str:
        # Format only when the message is shown: a noisy wire raises hundreds of these in one step.
        reason, line = self.args
        return f"{reason}: {line[:60]!r}"


class MotorCodec:
    """Plain lines with a speed of each motor, in the order of the letters."""

    def __init__(self, letters: str, trailing_comma: bool = False) -> None:
        self._letters = letters
        token = rb"([%b][pn])(%b)" % (letters.encode(), SPEED)
        self._line = re.compile(token + (rb", *" + token) * (len(letters) - 1) + rb"(?:, *)?")
        self._by_word = {
            letter.encode() + direction: (motor, way)
            for motor, letter in enumerate(letters)
            for direction, way in ((b"p", 1.0), (b"n", -1.0))
        }
        self._end = b",\r\n" if trailing_comma else b"\r\n"
        self._unread = (math.inf,) * len(letters)
        self.stop = self.encode((0.0,) * len(letters))  # zero for all motors, with line end

    def encode(self, motors: Motors) -> bytes:
        """Return the line, with its end, for speeds clamped to 99.99 and rounded to 0.01 rad/s.

        Raises `ValueError` for a speed that is not finite, because that is a bug of the caller.
        """
        values = [_token(*item) for item in zip(self._letters, motors, strict=True)]
        return ",".join(values).encode() + self._end

    def decode(self, line: bytes) -> Motors:
        """Return the speeds in a plain line without its end. Raises `FrameError`."""
        match = self._line.fullmatch(line)
        if match is None:
            raise FrameError("malformed", line)
        words, places, motors = match.groups(), self._by_word, [*self._unread]
        for word, figure in zip(words[::2], words[1::2], strict=True):
            motor, way = places[word]
            motors[motor] = way * float(figure)
        if max(motors) > MAX_SPEED or min(motors) < -MAX_SPEED:
            raise FrameError("duplicate_wheel" if math.inf in motors else "over_range", line)
        return tuple(motors)


class Codec:
    """Plain lines for one assignment of the motors to the wheels."""

    def __init__(self, wheels: WheelMap, trailing_comma: bool = False) -> None:
        self.letters = wheels.letters
        self._line = MotorCodec(self.letters, trailing_comma)
        signs = [-1.0 if motor[0] == "-" else 1.0 for motor in wheels.motors]
        places = [self.letters.index(motor[1]) for motor in wheels.motors]
        # By motor: its wheel and its sign. By wheel: its motor and its sign, the rear like the
        # front if there are two.
        self._wheel_of = [(places.index(n), signs[places.index(n)]) for n in range(len(places))]
        motor_of = [*zip(places, signs, strict=True)]
        self._motor_of = motor_of if len(motor_of) == 4 else [*motor_of, *motor_of[::-1]]
        self.stop = self._line.stop
        self._last = (STILL, self.stop)

    def encode(self, speeds: WheelSpeeds) -> bytes:
        """Return the line for the wheels, as `MotorCodec.encode` does."""
        last, line = self._last
        if speeds != last:  # a steady command repeats its line in each period
            wheel = speeds.as_tuple()
            line = self._line.encode(tuple([sign * wheel[i] for i, sign in self._wheel_of]))
            self._last = (speeds, line)
        return line

    def wheels(self, motors: Motors) -> Wheels4:
        """Return values of the motors as values of the wheels, forward positive."""
        (a, of_a), (b, of_b), (c, of_c), (d, of_d) = self._motor_of
        return of_a * motors[a], of_b * motors[b], of_c * motors[c], of_d * motors[d]

    def decode(self, line: bytes) -> WheelSpeeds:
        """Return the wheel speeds in a plain line without its end. Raises `FrameError`."""
        return WheelSpeeds(*self.wheels(self._line.decode(line)))


def _token(letter: str, speed: float) -> str:
    # Round to whole hundredths before formatting: 9.999 must become 10.00 and not 010.00, and a
    # negative speed that rounds to zero must become p00.00 and not n00.00.
    if not math.isfinite(speed):
        raise ValueError(f"wheel speed {speed} is not finite")
    hundredths = int(min(abs(speed), MAX_SPEED) * 100 + 0.5)
    direction = "n" if speed < 0 and hundredths else "p"
    return f"{letter}{direction}{hundredths // 100:02d}.{hundredths % 100:02d}"
