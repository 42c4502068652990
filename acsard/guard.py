"""The last look at every outgoing line, with code of its own.

Shares nothing with `limits.py`, `codec.py` or `check.py`: it reads the finished bytes as the MCU
will, and lets them pass only if they are finite, within the hard limit, with a right check if they
have one, and no faster than the last line sent unless a fresh command, a live link and mode DRIVING
agreed (invariant 2). Without a link only zero passes. Anything else becomes the stop line, and the
reason goes back into the robot, which latches a fault.
"""

from __future__ import annotations

from functools import lru_cache

from acsard.config.settings import Config, Source
from acsard.values import Outputs

Wheels = tuple[int, int, int, int]
"""The motors a to d in hundredths of rad/s."""

_ZERO: Wheels = (0, 0, 0, 0)
_HEX = b"0123456789ABCDEF"


class Guard:
    """Passes a line on or replaces it with `stop`. Remembers nothing: the last line is told it."""

    def __init__(
        self,
        stop: bytes,
        wheel_speed: float,
        sources: tuple[Source, ...],
        require_check: bool = False,
    ) -> None:
        """`stop` is the plain stop line: an MCU in any state obeys it."""
        self._stop = stop
        self._require_check = require_check
        self._most = int(wheel_speed * 100 + 1)
        self._timeouts = {source.name: source.timeout * 1e9 for source in sources}

    @classmethod
    def of(cls, stop: bytes, config: Config) -> Guard:
        """That of a configuration."""
        check = config.mcu.link_check == "require"
        return cls(stop, config.limits.wheel_speed, config.commands.sources, require_check=check)

    def check(self, outputs: Outputs, last: bytes) -> tuple[bytes | None, str]:
        """The line that may really go out, and why it is not the one these outputs have, or "".

        `last` is the line that went out last, which an MCU with power is obeying.
        """
        line = outputs.line
        if line is None:
            return None, ""
        trip = self._objection(line, outputs, _wheels(last) or _ZERO)
        return (self._stop, trip) if trip else (line, "")

    def _objection(self, line: bytes, outputs: Outputs, before: Wheels) -> str:
        wheels = _wheels(line)
        if wheels is None or not (line[31:] == self._stop[31:] or self._sealed(line)):
            return "it is not a whole line of four wheels"
        if wheels == _ZERO:
            return ""
        if max(wheels) > self._most or min(wheels) < -self._most:
            return "a wheel is over limits.wheel_speed"
        if not outputs.linked:
            return "it moves a wheel without a link"
        if self._require_check and b"#" not in line:
            return "it moves a wheel without the check that mcu.link_check requires"
        grows = wheels != before and any(
            abs(new) > abs(old) or new * old < 0 for new, old in zip(wheels, before, strict=True)
        )
        if grows and not self._commanded(outputs):
            return "a wheel grows without a fresh command in mode driving"
        return ""

    def _commanded(self, outputs: Outputs) -> bool:
        timeout, arrived = self._timeouts.get(outputs.source), outputs.command_ns
        if outputs.mode != "driving" or timeout is None or arrived is None:
            return False
        # A command may arrive on Zenoh's thread just after this step's clock was read.
        return abs(outputs.now.mono_ns - arrived) <= timeout

    def _sealed(self, line: bytes) -> bool:
        """From column 31 on: the dialect's comma, `#`, two digits, perhaps `S` or `H`, a right
        check."""
        body, check = line[:-7], line[-7:]
        comma, mark = self._stop[31:-2], body[31:]
        digits = mark[len(comma) + 1 : len(comma) + 3]
        return (
            mark in [comma + b"#" + digits + letter for letter in (b"", b"S", b"H")]
            and len(digits) == 2
            and all(digit in _HEX for digit in digits)
            and check == b"*%04X\r\n" % _crc(body)
        )


@lru_cache(4)  # the line that went last was new a period ago
def _wheels(line: bytes) -> Wheels | None:
    """The four motors in hundredths of rad/s, by fixed columns; None when they do not fit."""
    found = []
    for motor, start in zip(b"abcd", (0, 8, 16, 24), strict=True):
        token = line[start : start + 7]
        digits = token[2:4] + token[5:7]
        right = len(token) == 7 and token[0] == motor and token[1] in b"pn" and token[4] == 0x2E
        if not right or not digits.isdigit() or (start and line[start - 1] != 0x2C):
            return None
        found.append(int(digits) if token[1] == 0x70 else -int(digits))
    return found[0], found[1], found[2], found[3]


def _crc(data: bytes) -> int:
    """CRC-16/XMODEM by the shifts of avr-libc's notes, not by the library that made the line."""
    crc = 0
    for byte in data:
        x = crc >> 8 ^ byte
        x ^= x >> 4
        crc = (crc << 8 ^ x << 12 ^ x << 5 ^ x) & 0xFFFF
    return crc
