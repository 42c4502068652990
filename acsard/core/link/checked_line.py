"""Encodes checked commands and decodes checked replies: lines with a sequence number and a CRC.

    command  ap12.50,bn08.75,cp15.00,dn10.25#07S*HHHH
    reply    ap12.50,bn08.75,cp15.00,dn10.25#07@TTTTAAAABBBBCCCCDDDD*HHHH

After `#` come the two digits of the sequence number. In a command, request letters may follow. In a
reply, `@` and the sample fields (the board's clock and its encoder counts) follow if the command
asked for them. After `*` comes the CRC-16/XMODEM of all characters before `*`. All digits after `#`
are upper-case hexadecimal, so a line can be written in only one way. `codec.py` handles the plain
part, which comes before `#`.
"""

from __future__ import annotations

import binascii
import re
import struct

from msgspec import Struct

from acsard.core.link.codec import FrameError

SEQUENCES = 256
"""Number of different sequence numbers. The number after 255 is 0."""

SAMPLE_REQUEST = b"S"
"""The request letter that asks for the sample fields."""

ECHO_MARK = b"H"
"""A request letter that the board ignores. The letter marks a line as a line of the daemon. Replies
contain no request letters, so a received line with this letter is an echo."""

# The pattern also restricts the characters of the plain part, because the CRC does not detect zero
# bytes in front of a line.
_REPLY = re.compile(rb"([a-dnp0-9., ]*)#([0-9A-F]{2})(?:@([0-9A-F]{20}))?\*([0-9A-F]{4})")

_QUESTION = re.compile(rb"[a-dnp0-9., ]*#[0-9A-F]{2}[G-Z]+\*([0-9A-F]{4})")

_SAMPLE = struct.Struct(">5H")


class Reading(Struct, frozen=True):
    """The sample fields of a reply: the board's clock and its encoder counts at the same moment.

    `mcu_ms` is the board's clock, ms. `counts` are the encoder counts of the motors a to d. A count
    rises when its motor turns in the positive (`p`) direction. All five numbers are modulo 65536.
    """

    mcu_ms: int
    counts: tuple[int, int, int, int]


class Checked(Struct, frozen=True):
    """A reply with a correct CRC, split into its parts.

    `plain` is the part before `#`, which contains the wheel speeds. `sequence` is the sequence
    number of the command that the board answers with this reply. `reading` is None if the reply has
    no sample fields.
    """

    plain: bytes
    sequence: int
    reading: Reading | None


def seal(line: bytes, sequence: int, letters: bytes = b"") -> bytes:
    """Return a plain command as a checked line: with sequence number, CRC and CR LF.

    `line` is the plain command, with or without CR LF. `sequence` is the sequence number, 0 to 255.
    `letters` are the request letters; b"" means none.
    """
    body = b"%b#%02X%b" % (line.removesuffix(b"\r\n"), sequence, letters)
    return b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


def has_request(line: bytes) -> bool:
    """Return whether a line without its line end is a correct checked line with request letters.

    Only the daemon sends such lines, so a received one is an echo.
    """
    match = _QUESTION.fullmatch(line)
    return match is not None and binascii.crc_hqx(line[:-5], 0) == int(match[1], 16)


def unseal(line: bytes) -> Checked:
    """Split a checked reply into its parts. Raise `FrameError` if the reply is not valid.

    `line` is the reply without its line end.
    """
    match = _REPLY.fullmatch(line)
    if match is None:
        has_suffix = b"#" in line or b"*" in line
        raise FrameError("crc_error" if has_suffix else "without_crc", line)
    plain, sequence, sample, crc = match.groups()
    if binascii.crc_hqx(line[:-5], 0) != int(crc, 16):
        raise FrameError("crc_error", line)
    return Checked(plain, int(sequence, 16), None if sample is None else _reading(sample))


def _reading(sample: bytes) -> Reading:
    mcu_ms, a, b, c, d = _SAMPLE.unpack(binascii.unhexlify(sample))
    return Reading(mcu_ms, (a, b, c, d))
