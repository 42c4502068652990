"""Encodes checked commands and decodes checked replies: lines with a sequence number and a CRC.

    command  ap12.50,bn08.75,cp15.00,dn10.25#07S*HHHH
    reply    ap12.50,bn08.75,cp15.00,dn10.25#07@TTTTAAAABBBBCCCCDDDD*HHHH

A line of two motors has two values, and its reply two counts.
`codec.py` handles the part before `#`. Then come the sequence number, request letters (a command)
or `@` and the sample fields (a reply to `S`), and `*` with the CRC-16/XMODEM of all before it. All
digits are upper-case hexadecimal, so a line can be written in only one way.
"""

from __future__ import annotations

import binascii
import re
import struct

from msgspec import Struct

from acsard.core.link.codec import FrameError

SEQUENCES = 256  # the number after 255 is 0

SAMPLE_REQUEST = b"S"  # asks for the sample fields

# The pattern also restricts the characters of the plain part, because the CRC does not detect zero
# bytes in front of a line. The sample fields are of four motors or of two.
_REPLY = re.compile(
    rb"([a-z0-9., ]*)#([0-9A-F]{2})(?:@([0-9A-F]{20}|[0-9A-F]{12}))?\*([0-9A-F]{4})"
)

# By the digits of the sample fields.
_FIELDS = {20: struct.Struct(">5H"), 12: struct.Struct(">3H")}


class Reading(Struct, frozen=True):
    """The sample fields of a reply: the board's clock, ms, and its encoder counts at that moment.

    The counts are in the order of the letters. One rises when its motor turns in the direction `p`.
    All are modulo 65536.
    """

    mcu_ms: int
    counts: tuple[int, ...]


class Checked(Struct, frozen=True):
    """A reply with a correct CRC: the part before `#`, its command's number, the sample if any."""

    plain: bytes
    sequence: int
    reading: Reading | None


def seal(line: bytes, sequence: int, letters: bytes = b"") -> bytes:
    """Return a plain command (with or without CR LF) as a checked line with CR LF."""
    body = b"%b#%02X%b" % (line.removesuffix(b"\r\n"), sequence, letters)
    return b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


def unseal(line: bytes, motors: int) -> Checked:
    """Split a checked reply of this number of motors, without its line end, into its parts.

    Raises `FrameError`.
    """
    match = _REPLY.fullmatch(line)
    if match is None:
        has_suffix = b"#" in line or b"*" in line
        raise FrameError("crc_error" if has_suffix else "without_crc", line)
    plain, sequence, sample, crc = match.groups()
    if binascii.crc_hqx(line[:-5], 0) != int(crc, 16):
        raise FrameError("crc_error", line)
    if sample is None:
        return Checked(plain, int(sequence, 16), None)
    mcu_ms, *counts = _FIELDS[len(sample)].unpack(binascii.unhexlify(sample))
    if len(counts) != motors:
        raise FrameError("malformed", line)
    return Checked(plain, int(sequence, 16), Reading(mcu_ms, tuple(counts)))
