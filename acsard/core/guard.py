"""Checks every outgoing line a second time, with no code of the parts that made it.

It parses the bytes as the MCU does. The format, the checksum and `limits.wheel_speed` must be
right; only a question has no speeds. No wheel gets faster or turns round without a fresh command,
the link and the mode `driving`. All wheels are zero without the link, before the first fresh
command, and `RAMP_MARGIN_NS` after the longest ramp to rest since the last fresh command or since a
stop began. Zeros replace a line that breaks a rule, and the robot latches a fault.
"""

from __future__ import annotations

import re
from functools import lru_cache

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.values import NS_PER_S, Ns, Status, Trip

Hundredths = tuple[int, ...]  # speeds of the motors, in hundredths of rad/s

_WORD = re.compile(rb"[a-z]([pn])(\d\d)\.(\d\d)")
_WORD_BYTES = 8  # with the comma
_SEAL = re.compile(rb"#[0-9A-F]{2}S?\*[0-9A-F]{4}\r\n")
_QUESTION = b"?\r\n"

HALTED = ("stopped", "fault", "shutdown")  # modes with the stop deceleration

# Like the watchdog of the board, which stops the motors by itself without lines.
RAMP_MARGIN_NS = 300_000_000


class Memory(Struct, frozen=True):
    """The state that a guard keeps from one line to the next; a recording stores it for replays."""

    last: bytes = b""  # written to the serial port
    commanded_ns: Ns | None = None  # last line with a fresh command in mode `driving`
    halted_ns: Ns | None = None  # begin of the present mode of `HALTED`
    # From full speed to rest, the longest under any limits since the robot was last at rest.
    ramp_ns: Ns = 0
    stop_ramp_ns: Ns = 0  # from full speed to rest in a stop, likewise


class Guard:
    """Checks each line to the board, and replaces a forbidden line with the stop line (zeros)."""

    def __init__(self, stop: bytes, config: Config, memory: Memory | None = None) -> None:
        # `stop` has zeros and no checksum: the board accepts it in any state of the link.
        self._stop, self._letters = stop, config.mcu.wheels.letters.encode()
        self._size, self._zero = _WORD_BYTES * len(self._letters) - 1, (0,) * len(self._letters)
        memory = memory or Memory()
        self._last, self._hundredths = memory.last, self._speeds(memory.last)
        self._commanded_ns, self._halted_ns = memory.commanded_ns, memory.halted_ns
        self._longest = memory.ramp_ns, memory.stop_ramp_ns
        self.use(config)

    def use(self, config: Config) -> None:
        """Use other settings from now on.

        A moving robot may still brake by the old limits, so until it is at rest the longer braking
        time of both is allowed.
        """
        self._require_check = config.mcu.link_check == "on"
        self._most = int(config.limits.wheel_speed * 100 + 1)
        self._timeouts = {s.name: s.timeout * 1e9 for s in config.commands.sources}
        self._ramps = _ramp_ns(config, stop=False), _ramp_ns(config, stop=True)
        if self._hundredths == self._zero:
            self._longest = self._ramps
        else:
            (ramp, stop_ramp), (now, stop_now) = self._longest, self._ramps
            self._longest = max(ramp, now), max(stop_ramp, stop_now)

    @property
    def memory(self) -> Memory:
        return Memory(self._last, self._commanded_ns, self._halted_ns, *self._longest)

    def record_written(self, line: bytes) -> None:
        """Record that `line` was written to the serial port."""
        if line == _QUESTION:
            return
        self._last, self._hundredths = line, self._speeds(line)
        if self._hundredths == self._zero:
            self._longest = self._ramps

    def check(
        self, line: bytes, now_ns: Ns, status: Status, command_ns: Ns | None
    ) -> tuple[bytes, Trip]:
        """Return the line to send, and why it is not the robot's.

        `command_ns` is the arrival of the command of `status.source`.
        """
        mode = status.mode
        commanded = mode == "driving" and self._is_fresh(status.source, command_ns, now_ns)
        if commanded:
            self._commanded_ns = now_ns
        if mode not in HALTED:
            self._halted_ns = None
        elif self._halted_ns is None:
            self._halted_ns = now_ns
        if line == _QUESTION:
            return line, ""
        trip = self._objection(line, now_ns, commanded, status.link == "up")
        return (self._stop, trip) if trip else (line, "")

    def _objection(self, line: bytes, now_ns: Ns, commanded: bool, linked: bool) -> Trip:
        before, size = self._hundredths or self._zero, self._size
        speeds = self._speeds(line)
        if speeds is None or not (line[size:] == self._stop[size:] or self._sealed(line)):
            return "guard_line_damaged"
        if speeds == self._zero:
            return ""
        if max(speeds) > self._most or min(speeds) < -self._most:
            return "guard_too_fast"
        if not linked:
            return "guard_no_link"
        if self._require_check and b"#" not in line:
            return "guard_no_checksum"
        grows = speeds != before and any(
            abs(new) > abs(old) or new * old < 0 for new, old in zip(speeds, before, strict=True)
        )
        if grows and not commanded:
            return "guard_no_command"
        if self._late(now_ns):
            return "guard_too_long"
        return ""

    def _late(self, now_ns: Ns) -> bool:
        (ramp_ns, stop_ramp_ns), since_ns = self._longest, self._commanded_ns
        if since_ns is None or now_ns - since_ns > ramp_ns + RAMP_MARGIN_NS:
            return True
        halted_ns = self._halted_ns
        return halted_ns is not None and now_ns - halted_ns > stop_ramp_ns + RAMP_MARGIN_NS

    def _is_fresh(self, source: str, command_ns: Ns | None, now_ns: Ns) -> bool:
        timeout_ns = self._timeouts.get(source)
        if timeout_ns is None or command_ns is None:
            return False
        # Compare the absolute difference: a command may arrive on Zenoh's thread just after this
        # step read the clock.
        return abs(now_ns - command_ns) <= timeout_ns

    def _sealed(self, line: bytes) -> bool:
        # The end is: a comma if the board needs one, `#` and the sequence number (two hexadecimal
        # digits), at most one request letter, `*` and the CRC-16/XMODEM of all before it.
        size, comma = self._size, self._stop[self._size : -2]
        return (
            line[size:].startswith(comma)
            and _SEAL.fullmatch(line, size + len(comma)) is not None
            and line[-7:] == b"*%04X\r\n" % _crc(line[:-7])
        )

    def _speeds(self, line: bytes) -> Hundredths | None:
        return _hundredths(line[: self._size], self._letters)


def _ramp_ns(config: Config, *, stop: bool) -> Ns:
    # From the highest speed to rest. Jerk limits do not affect braking.
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
def _hundredths(columns: bytes, letters: bytes) -> Hundredths | None:
    # In 0.01 rad/s, in the order of the letters; None if a column is malformed.
    words = columns.split(b",")
    if b"".join([word[:1] for word in words]) != letters:
        return None
    speeds = []
    for word in words:
        match = _WORD.fullmatch(word)
        if match is None:
            return None
        way, whole, part = match.groups()
        speeds.append(int(whole + part) if way == b"p" else -int(whole + part))
    return tuple(speeds)


def _crc(data: bytes) -> int:
    # CRC-16/XMODEM
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_OF_BYTE[crc >> 8 ^ byte]
    return crc


def _crc_of(byte: int) -> int:
    # One byte, computed by shifts as in the notes of avr-libc.
    x = byte ^ byte >> 4
    return (x << 12 ^ x << 5 ^ x) & 0xFFFF


_CRC_OF_BYTE = [_crc_of(byte) for byte in range(256)]
