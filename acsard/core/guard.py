"""Checks every outgoing line a second time, with code of its own.

The guard shares no code with `limits.py`, `codec.py` or `checksum.py`. It reads the finished bytes as
the MCU will, and passes a line only if all of these hold:

- The line is whole, within the hard limit, and its check is right. Only `link_check = "require"`
  asks for a check on a line that moves a wheel.
- No wheel is faster than in the last line sent, unless a fresh command, a live link and mode
  `driving` agree (invariant 2).
- With no link, all wheels are zero.

Otherwise the guard replaces the line with the stop line. It hands the reason to the robot, which
latches a fault.

The guard also checks that the robot comes to rest. When the last fresh command is older than the
longest ramp that the limits allow, only zero passes. After a stop, a fault or the end of the daemon
the longest ramp at the stop deceleration counts. The guard remembers these times, so a recording
keeps its `Memory` as well as the robot.
"""

from __future__ import annotations

import re
from functools import lru_cache

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.values import NS_PER_S, Outputs

Wheels = tuple[int, int, int, int]
"""The motors a to d in hundredths of rad/s."""

_ZERO: Wheels = (0, 0, 0, 0)
_HEX = b"0123456789ABCDEF"
_COLUMNS = re.compile(rb"a([pn]\d\d\.\d\d),b([pn]\d\d\.\d\d),c([pn]\d\d\.\d\d),d([pn]\d\d\.\d\d)")

HALTED = ("stopped", "fault", "shutdown")
"""Modes in which the robot brakes at the stop deceleration."""

MARGIN_NS = 300_000_000
"""Allowed beyond the longest ramp. The board stops by itself after a pause this long between two
lines, so no ramp of the daemon is later than that."""


class Memory(Struct, frozen=True):
    """Everything that a guard remembers from one line to the next."""

    last: bytes = b""
    """The line that left last, which an MCU with power is obeying. Empty at the start."""
    commanded_ns: int | None = None
    """When a fresh command was last followed in mode `driving`, monotonic."""
    halted_ns: int | None = None
    """When the mode became one of `HALTED`, monotonic. None in any other mode."""
    ramp_ns: int = 0
    """Longest ramp to rest under any limits in force since the robot was last at rest."""
    stop_ramp_ns: int = 0
    """Longest ramp to rest at the stop decelerations, since the robot was last at rest."""


class Guard:
    """Passes a line on or replaces it with `stop`."""

    def __init__(self, stop: bytes, config: Config, memory: Memory | None = None) -> None:
        """`stop` is the plain stop line: an MCU in any state obeys it."""
        self._stop = stop
        memory = memory or Memory()
        self._last = memory.last
        self._commanded_ns, self._halted_ns = memory.commanded_ns, memory.halted_ns
        self._longest = memory.ramp_ns, memory.stop_ramp_ns
        self.use(config)

    def use(self, config: Config) -> None:
        """Check by this configuration from now on. The memory stays."""
        self._require_check = config.mcu.link_check == "require"
        self._most = int(config.limits.wheel_speed * 100 + 1)
        self._timeouts = {s.name: s.timeout * 1e9 for s in config.commands.sources}
        self._ramps = _ramp_ns(config, stop=False), _ramp_ns(config, stop=True)
        self._note_limits()

    @property
    def memory(self) -> Memory:
        """The memory that lets another guard continue."""
        return Memory(self._last, self._commanded_ns, self._halted_ns, *self._longest)

    def left(self, line: bytes) -> None:
        """Note that this line went out."""
        self._last = line
        self._note_limits()

    def check(self, outputs: Outputs) -> tuple[bytes | None, str]:
        """Return the line that may leave, and the reason if it replaces the one of these outputs.

        The line is None if none is due. The reason is "" if the line is passed unchanged.
        """
        if outputs.mode == "driving":
            if self._commanded(outputs):
                self._commanded_ns = outputs.now.mono_ns
            self._halted_ns = None
        elif outputs.mode not in HALTED:
            self._halted_ns = None
        elif self._halted_ns is None:
            self._halted_ns = outputs.now.mono_ns
        line = outputs.line
        if line is None:
            return None, ""
        trip = self._objection(line, outputs, _wheels(self._last) or _ZERO)
        return (self._stop, trip) if trip else (line, "")

    def _note_limits(self) -> None:
        """Let a robot in motion end its ramp by the limits under which it began to move."""
        if _wheels(self._last) == _ZERO:
            self._longest = self._ramps
        else:
            (ramp, stop_ramp), (now, stop_now) = self._longest, self._ramps
            self._longest = max(ramp, now), max(stop_ramp, stop_now)

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
            return "a wheel speeds up without a fresh command in mode driving"
        if self._late(outputs.now.mono_ns):
            return "it still moves a wheel although the longest ramp to rest is over"
        return ""

    def _late(self, now_ns: int) -> bool:
        """Return whether the robot must be at rest by now."""
        (ramp_ns, stop_ramp_ns), since_ns = self._longest, self._commanded_ns
        if since_ns is None or now_ns - since_ns > ramp_ns + MARGIN_NS:
            return True
        halted_ns = self._halted_ns
        return halted_ns is not None and now_ns - halted_ns > stop_ramp_ns + MARGIN_NS

    def _commanded(self, outputs: Outputs) -> bool:
        timeout, arrived = self._timeouts.get(outputs.source), outputs.command_ns
        if outputs.mode != "driving" or timeout is None or arrived is None:
            return False
        # A command may arrive on Zenoh's thread just after this step's clock was read.
        return abs(outputs.now.mono_ns - arrived) <= timeout

    def _sealed(self, line: bytes) -> bool:
        """Return whether the end of a line, from column 31 on, is that of the checked link.

        It is the comma of the dialect, `#`, two digits, perhaps `S` or `H`, and a right check.
        """
        body, check = line[:-7], line[-7:]
        comma, mark = self._stop[31:-2], body[31:]
        digits = mark[len(comma) + 1 : len(comma) + 3]
        return (
            mark in [comma + b"#" + digits + letter for letter in (b"", b"S", b"H")]
            and len(digits) == 2
            and all(digit in _HEX for digit in digits)
            and check == b"*%04X\r\n" % _crc(body)
        )


def _ramp_ns(config: Config, *, stop: bool) -> int:
    """Return how long the limits let the robot take from its highest speed to rest, in ns.

    No twist is faster than its own limit or than all wheels at theirs. Both axes reach rest
    together, at the pace of the slower one. Jerk shapes speeding up only.
    """
    limits, drive = config.limits, config.drive
    sides = drive.left_wheel_radius_multiplier + drive.right_wheel_radius_multiplier
    rim = limits.wheel_speed * drive.wheel_radius * sides / 2
    half_track = drive.wheel_separation * drive.wheel_separation_multiplier / 2
    linear = min(limits.linear_speed, rim)
    angular = min(limits.angular_speed, rim / half_track)
    if stop:
        by = limits.linear_stop_deceleration, limits.angular_stop_deceleration
    else:
        by = limits.linear_deceleration, limits.angular_deceleration
    return int(max(linear / by[0], angular / by[1]) * NS_PER_S)


# The last line sent is decoded again with the next one.
@lru_cache(4)
def _wheels(line: bytes) -> Wheels | None:
    """Return the four speeds in 0.01 rad/s by fixed columns, None if the columns do not fit."""
    match = _COLUMNS.match(line)
    if match is None:
        return None
    a, b, c, d = [
        int(word[1:3] + word[4:]) if word[0] == 0x70 else -int(word[1:3] + word[4:])
        for word in match.groups()
    ]
    return a, b, c, d


def _crc(data: bytes) -> int:
    """Return the CRC-16/XMODEM by the shifts of avr-libc's notes.

    This does not use the library that sealed the line, so an error there is noticed here.
    """
    crc = 0
    for byte in data:
        x = crc >> 8 ^ byte
        x ^= x >> 4
        crc = (crc << 8 ^ x << 12 ^ x << 5 ^ x) & 0xFFFF
    return crc
