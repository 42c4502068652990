"""The serial protocol on the side of the board: the commands that it obeys, and its replies.

There is one decoder for each kind of firmware. A checked line is a plain one with a suffix of a
sequence number and a checksum. The module shares no code with the host.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

from msgspec import Struct

HEX = b"0123456789ABCDEF"

VALUE_LENGTH = 8  # bytes, with the comma after the value


class BoardCommand(Struct, frozen=True):
    """A valid command line from the host."""

    values: dict[int, float]  # rad/s, by motor: its place among the board's letters
    sequence: bytes = b""  # two digits of a checked line
    wants_sample: bool = False  # the reply must contain the board's time and its encoder counts


def reference(line: bytes, letters: str) -> BoardCommand | None:
    """Decode a plain or checked line as the reference firmware does; None if it is not valid."""
    text = line.removesuffix(b"\n").removesuffix(b"\r")
    if b"#" not in text and b"*" not in text:
        return _plain(text, letters)
    body, check = text[:-5], text[-5:]
    plain, _, suffix = body.partition(b"#")
    if check != b"*%04X" % _crc(body[len(plain) :], _crc_of_plain(plain)):
        return None
    sequence, requests = suffix[:2], suffix[2:]
    if len(sequence) != 2 or any(digit not in HEX for digit in sequence):
        return None
    if not all(0x47 <= letter <= 0x5A for letter in requests):  # G to Z
        return None
    command = _plain(plain, letters)
    return command and BoardCommand(command.values, sequence, b"S" in requests)


def plain_only(line: bytes, letters: str) -> BoardCommand | None:
    """Decode a line as firmware without checksums does; None if it is not plain."""
    return _plain(line.removesuffix(b"\n").removesuffix(b"\r"), letters)


def prefix(line: bytes, letters: str) -> BoardCommand | None:
    """Decode a line and ignore all after the speeds, as some firmware does, or return None.

    A line that goes on with the speed of another motor is of a robot with more motors, not valid.
    """
    end = VALUE_LENGTH * len(letters) - 1
    other = re.match(rb",([a-z])[pn]", line[end:])
    return None if other and other[1].decode() not in letters else _plain(line[:end], letters)


def latched(line: bytes, letters: str) -> BoardCommand:
    """Decode a line as old firmware does: obey each speed that is followed by a comma.

    The rest of the line need not be valid.
    """
    values, motors = {}, letters.encode()
    for token in line.split(b",")[:-1]:
        motor, sign = token[:1], token[1:2]
        if motor and motor in motors and sign in (b"p", b"n"):
            try:
                value = float(token[2:])
            except ValueError:
                continue
            if math.isfinite(value):
                values[motors.index(motor)] = value if sign == b"p" else -value
    return BoardCommand(values)


# By firmware.
DECODERS: dict[str, Callable[[bytes, str], BoardCommand | None]] = {
    "reference": reference,
    "plain_only": plain_only,
    "prefix": prefix,
    "latched": latched,
}


def _plain(text: bytes, letters: str) -> BoardCommand | None:
    values = _values(text, letters)
    return None if values is None else BoardCommand(dict(enumerate(values)))


# A robot at a constant speed gets the same values again and again, so they are cached.
@lru_cache(256)
def _values(text: bytes, letters: str) -> tuple[float, ...] | None:
    values = ",".join([rf"{letter}([pn]\d\d\.\d\d)" for letter in letters])
    match = re.fullmatch(values.encode() + b",?", text)
    return None if match is None else tuple(map(_value, match.groups()))


def _value(word: bytes) -> float:
    size = int(word[1:3]) + int(word[4:]) / 100
    return -size if word[0] == 0x6E else size


@lru_cache(1024)
def speeds_text(letters: str, speeds: tuple[float, ...], separator: str, unpadded: bool) -> bytes:
    """Return the plain part of a reply; unpadded speeds below ten have one integer digit."""
    form = "%s%s%.2f" if unpadded else "%s%s%05.2f"
    words = [
        form % (motor, "n" if speed < 0 else "p", min(abs(speed), 99.99))
        for motor, speed in zip(letters, speeds, strict=True)
    ]
    return separator.join(words).encode()


def suffix(text: bytes, sequence: bytes, sample: Sequence[int]) -> bytes:
    """Return the suffix of a checked reply to the command with these two digits of `sequence`.

    `sample` is the board's time in ms and the counts, or empty.
    """
    body = b"#" + sequence
    if sample:
        body += b"@" + b"".join([b"%04X" % (number & 0xFFFF) for number in sample])
    return body + b"*%04X" % _crc(body, _crc_of_plain(text))


def status(fields: Mapping[str, str], check: bool) -> bytes:
    """Return a status line with fields such as `{"estop": "ok"}`, with a checksum if `check`."""
    text = "".join(["!status", *(f" {name}={value}" for name, value in fields.items())]).encode()
    return text + (b"*%04X" % _crc(text) if check else b"") + b"\r\n"


def identity(counts: int, watchdog_ms: int, sample: bool) -> bytes:
    """Return the line with which the firmware identifies itself.

    `sample` says that replies can contain the board's time and encoder counts.
    """
    text = f"!acsard-mcu 1 counts={counts} watchdog_ms={watchdog_ms} check=1 sample={int(sample)}"
    return text.encode() + b"\r\n"


def _crc(data: bytes, crc: int = 0) -> int:
    # CRC-16/XMODEM: x^16 + x^12 + x^5 + 1
    table = _CRC_OF
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ table[crc >> 8 ^ byte]
    return crc


@lru_cache(1024)
def _crc_of_plain(text: bytes) -> int:
    return _crc(text)


def _crc_of(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1 & 0xFFFF) ^ (0x1021 if crc >> 15 else 0)
    return crc


_CRC_OF = [_crc_of(byte) for byte in range(256)]
