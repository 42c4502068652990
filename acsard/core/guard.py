"""Checks every outgoing line a second time, independently of the code that made the line.

The guard shares no code with `limits.py`, `codec.py` or `checked_line.py`. It parses the finished
bytes in the same way as the MCU, and passes a line only if all of these conditions hold:

- The line has the complete format, no wheel exceeds `limits.wheel_speed`, and the checksum is
  correct if the line has a checksum. With `link_check = "require"`, a line that moves a wheel must
  have a checksum.
- No wheel is faster than in the last line sent, and no wheel has changed its direction since that
  line. This does not apply if there is a fresh command, the link is up and the mode is `driving`
  (rule 2 of `acsard/README.md`).
- Without a link, all wheel speeds are zero.
- All wheel speeds are zero before the first fresh command, and when the last fresh command is older
  than the longest ramp to rest plus `RAMP_MARGIN_NS`.
- All wheel speeds are zero when a stop, a fault or a shutdown began longer ago than the duration of
  the longest stop plus `RAMP_MARGIN_NS`.

If a condition does not hold, the guard replaces the line with the stop line, and the robot latches
a fault. The guard keeps the times of the last fresh command and of the last stop in its `Memory`. A
recording stores the `Memory`, so that the guard makes the same decisions in a replay.
"""

from __future__ import annotations

import re
from functools import lru_cache

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.values import NS_PER_S, Outputs

Wheels = tuple[int, int, int, int]
"""Speeds of the motors a to d, in hundredths of rad/s."""

_ZERO: Wheels = (0, 0, 0, 0)
_COLUMNS = re.compile(rb"a([pn]\d\d\.\d\d),b([pn]\d\d\.\d\d),c([pn]\d\d\.\d\d),d([pn]\d\d\.\d\d)")
_SEAL = re.compile(rb"#[0-9A-F]{2}[SH]?\*[0-9A-F]{4}\r\n")

HALTED = ("stopped", "fault", "shutdown")
"""Modes in which the robot brakes at the stop deceleration."""

RAMP_MARGIN_NS = 300_000_000
"""Extra time after the computed end of a ramp to rest, ns, in which the guard still passes lines
that move a wheel. It equals the watchdog time of the board, after which a board without lines stops
the motors by itself."""


class Memory(Struct, frozen=True):
    """The state that a guard keeps from one line to the next."""

    last: bytes = b""
    """The last line that was written to the serial port; b"" before the first line."""
    commanded_ns: int | None = None
    """Monotonic time of the last control step that had a fresh command in mode `driving`, ns. None
    before the first such step."""
    halted_ns: int | None = None
    """Monotonic time at which the robot began to brake for a stop, a fault or a shutdown, ns. None
    if the mode is not one of `HALTED`."""
    ramp_ns: int = 0
    """Duration of a ramp from full speed to rest, ns. If the limits have changed since the robot
    was last at rest, this is the longest duration under any of these limits."""
    stop_ramp_ns: int = 0
    """Duration of a stop from full speed, ns. If the limits have changed since the robot was last
    at rest, this is the longest duration under any of these limits."""


class Guard:
    """Checks each line to the board, and replaces a forbidden line with the stop line (zeros)."""

    def __init__(self, stop: bytes, config: Config, memory: Memory | None = None) -> None:
        """Start with the state `memory` of an earlier guard, or with an empty `Memory`.

        `stop` is the line that the guard sends instead of a forbidden line. It contains zeros and
        no checksum, and the board accepts it in any state of the link.
        """
        self._stop = stop
        memory = memory or Memory()
        self._last, self._wheels = memory.last, _wheels(memory.last[:31])
        """The last line that was written to the port, and its wheel speeds."""
        self._commanded_ns, self._halted_ns = memory.commanded_ns, memory.halted_ns
        self._longest = memory.ramp_ns, memory.stop_ramp_ns
        self.use(config)

    def use(self, config: Config) -> None:
        """Use the configuration `config` from now on.

        A moving robot may still brake by the old limits. Therefore the guard allows the longer one
        of the old and the new braking time until the robot is at rest.
        """
        self._require_check = config.mcu.link_check == "require"
        self._most = int(config.limits.wheel_speed * 100 + 1)
        self._timeouts = {s.name: s.timeout * 1e9 for s in config.commands.sources}
        self._ramps = _ramp_ns(config, stop=False), _ramp_ns(config, stop=True)
        if self._wheels == _ZERO:
            self._longest = self._ramps
        else:
            (ramp, stop_ramp), (now, stop_now) = self._longest, self._ramps
            self._longest = max(ramp, now), max(stop_ramp, stop_now)

    @property
    def memory(self) -> Memory:
        """The state of this guard. A new `Guard` that starts with it makes the same decisions."""
        return Memory(self._last, self._commanded_ns, self._halted_ns, *self._longest)

    def record_written(self, line: bytes) -> None:
        """Record that `line` was written to the serial port."""
        self._last, self._wheels = line, _wheels(line[:31])
        if self._wheels == _ZERO:
            self._longest = self._ramps

    def check(self, outputs: Outputs) -> tuple[bytes | None, str]:
        """Return the line to send, and the reason why the guard replaced the robot's line.

        The guard replaces a forbidden line with the stop line. The reason is "" if the guard did
        not replace the line. If `outputs` does not contain a line, the result is (None, "").
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
        trip = self._objection(line, outputs, self._wheels or _ZERO)
        return (self._stop, trip) if trip else (line, "")

    def _objection(self, line: bytes, outputs: Outputs, before: Wheels) -> str:
        wheels = _wheels(line[:31])
        if wheels is None or not (line[31:] == self._stop[31:] or self._sealed(line)):
            return "the line is not complete, or does not have four wheel speeds"
        if wheels == _ZERO:
            return ""
        if max(wheels) > self._most or min(wheels) < -self._most:
            return "the line moves a wheel faster than limits.wheel_speed"
        if not outputs.linked:
            return "the line moves a wheel while the serial link is not up"
        if self._require_check and b"#" not in line:
            return "the line moves a wheel without the checksum that mcu.link_check requires"
        grows = wheels != before and any(
            abs(new) > abs(old) or new * old < 0 for new, old in zip(wheels, before, strict=True)
        )
        if grows and not self._commanded(outputs):
            return (
                "the line speeds up a wheel although no command is fresh, or although the mode is "
                "not driving"
            )
        if self._late(outputs.now.mono_ns):
            return "the line still moves a wheel although the longest ramp to zero has ended"
        return ""

    def _late(self, now_ns: int) -> bool:
        (ramp_ns, stop_ramp_ns), since_ns = self._longest, self._commanded_ns
        if since_ns is None or now_ns - since_ns > ramp_ns + RAMP_MARGIN_NS:
            return True
        halted_ns = self._halted_ns
        return halted_ns is not None and now_ns - halted_ns > stop_ramp_ns + RAMP_MARGIN_NS

    def _commanded(self, outputs: Outputs) -> bool:
        timeout, arrived = self._timeouts.get(outputs.source), outputs.command_ns
        if outputs.mode != "driving" or timeout is None or arrived is None:
            return False
        # Compare the absolute difference: a command may arrive on Zenoh's thread just after this
        # step read the clock.
        return abs(outputs.now.mono_ns - arrived) <= timeout

    def _sealed(self, line: bytes) -> bool:
        """Return whether a line ends with a sequence number and a correct checksum.

        After the four speeds (the first 31 characters), the line must consist of these parts, in
        this order:

        - a comma, if the board needs a comma at the end of the speeds
        - `#`, and the sequence number of the line as two hexadecimal digits
        - at most one request letter: `S` or `H`
        - `*`, and the CRC-16/XMODEM of all characters before `*` as four hexadecimal digits
        - a carriage return and a line feed
        """
        comma = self._stop[31:-2]
        return (
            line[31:].startswith(comma)
            and _SEAL.fullmatch(line, 31 + len(comma)) is not None
            and line[-7:] == b"*%04X\r\n" % _crc(line[:-7])
        )


def _ramp_ns(config: Config, *, stop: bool) -> int:
    """Return the time to brake from the highest speed to rest, ns.

    If `stop` is true, the robot brakes at the stop deceleration, otherwise at the normal
    deceleration. Jerk limits do not affect braking.
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


# A steady command repeats the same columns in each line, so a cache of a few lines saves most work.
@lru_cache(4)
def _wheels(columns: bytes) -> Wheels | None:
    """Return the speeds of the motors a to d, in 0.01 rad/s, or None if a column is malformed.

    `columns` are the first 31 bytes of a line, without sequence number and checksum.
    """
    match = _COLUMNS.match(columns)
    if match is None:
        return None
    a, b, c, d = [
        int(word[1:3] + word[4:]) if word[0] == 0x70 else -int(word[1:3] + word[4:])
        for word in match.groups()
    ]
    return a, b, c, d


def _crc(data: bytes) -> int:
    """Return the CRC-16/XMODEM of `data`."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_OF_BYTE[crc >> 8 ^ byte]
    return crc


def _crc_of(byte: int) -> int:
    """Return the CRC-16/XMODEM of one byte, computed by shifts as in the notes of avr-libc."""
    x = byte ^ byte >> 4
    return (x << 12 ^ x << 5 ^ x) & 0xFFFF


_CRC_OF_BYTE = [_crc_of(byte) for byte in range(256)]
