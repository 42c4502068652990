"""The last look at every outgoing line, with code of its own.

Shares nothing with `limits.py` or `frames.py`: it reads the finished bytes as the MCU will, and
lets them pass only if they are finite, within the hard limit, and no faster than the last line sent
unless a fresh command, a live link and mode DRIVING agreed (invariant 2). Without a link only
zero passes. Anything else becomes the stop line, and the reason goes back into the robot, which
latches a fault.
"""

from __future__ import annotations

from acsard.settings import Source
from acsard.values import Outputs

_ZERO = (0, 0, 0, 0)


class Guard:
    """Passes a line on or replaces it with `stop`; `trip` says why it did."""

    def __init__(self, stop: bytes, wheel_speed: float, sources: tuple[Source, ...]) -> None:
        self._stop = stop
        self._length = len(stop)
        self._most = int(wheel_speed * 100 + 1)
        self._timeouts = {source.name: source.timeout * 1e9 for source in sources}
        self._sent = _ZERO
        self._passed = _ZERO
        self.trip = ""
        """Why the line just checked was replaced; "" when it passed."""

    def check(self, outputs: Outputs) -> bytes | None:
        """The line that may really go out for these outputs."""
        self.trip = ""
        line = outputs.line
        if line is None:
            return None
        wheels = self._read(line)
        self.trip = self._objection(wheels, outputs)
        if self.trip or wheels is None:
            self._passed = _ZERO
            return self._stop
        self._passed = wheels
        return line

    def note_sent(self) -> None:
        """The line passed last has gone out: the next one is compared with it."""
        self._sent = self._passed

    def _objection(self, wheels: tuple[int, int, int, int] | None, outputs: Outputs) -> str:
        if wheels is None:
            return "it is not a whole line of four wheels"
        if wheels == _ZERO:
            return ""
        if max(wheels) > self._most or min(wheels) < -self._most:
            return "a wheel is over limits.wheel_speed"
        if not outputs.linked:
            return "it moves a wheel without a link"
        grows = any(
            abs(new) > abs(old) or new * old < 0
            for new, old in zip(wheels, self._sent, strict=True)
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

    def _read(self, line: bytes) -> tuple[int, int, int, int] | None:
        """The four motors in hundredths of rad/s, by fixed columns; None when they do not fit."""
        if len(line) != self._length or line[31:] != self._stop[31:]:
            return None
        found = []
        for motor, start in zip(b"abcd", (0, 8, 16, 24), strict=True):
            token = line[start : start + 7]
            digits = token[2:4] + token[5:7]
            right = token[0] == motor and token[1] in b"pn" and token[4] == 0x2E
            if not right or not digits.isdigit() or (start and line[start - 1] != 0x2C):
                return None
            found.append(int(digits) if token[1] == 0x70 else -int(digits))
        return found[0], found[1], found[2], found[3]
