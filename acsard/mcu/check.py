"""The checked line: the plain one with a suffix that proves it whole and says what it answers.

    command  ap12.50,bn08.75,cp15.00,dn10.25#07S*HHHH
    reply    ap12.50,bn08.75,cp15.00,dn10.25#07@TTTTAAAABBBBCCCCDDDD*HHHH

`#` and the sequence, two digits; then the letters of a command's requests, or the sample fields of
a reply that was asked for them; `*` and the CRC-16/XMODEM of everything before it. All digits are
hexadecimal and upper-case: a line has one right form. The plain part is `codec.py`'s.
"""

from __future__ import annotations

import binascii
import re

from msgspec import Struct

from acsard.mcu.codec import FrameError

SEQUENCES = 256
"""The sequence counts modulo this."""

ASK_SAMPLE = b"S"
"""The request letter that asks for the sample fields."""

ASK_NOTHING = b"H"
"""A request letter that asks for nothing, which an MCU ignores: a line that comes back with it is
an echo, for no reply has one."""

# The plain part's characters too: zero bytes in front of a line do not change an XMODEM check.
_REPLY = re.compile(rb"([a-dnp0-9., ]*)#([0-9A-F]{2})(?:@([0-9A-F]{20}))?\*([0-9A-F]{4})")


class Reading(Struct, frozen=True):
    """The sample fields: the MCU's milliseconds when it read its encoders, and what they showed.

    `counts` are those of the motors a to d, up when the motor turns in its `p` direction; all five
    are modulo 65536.
    """

    mcu_ms: int
    counts: tuple[int, int, int, int]


class Checked(Struct, frozen=True):
    """A reply whose check is right: its plain part, the sequence it answers and its sample."""

    plain: bytes
    sequence: int
    reading: Reading | None


def seal(line: bytes, sequence: int, letters: bytes = b"") -> bytes:
    """The command line (with its CR LF) with the suffix for this sequence and these requests."""
    body = b"%b#%02X%b" % (line.removesuffix(b"\r\n"), sequence, letters)
    return b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


def unseal(line: bytes) -> Checked:
    """The parts of a reply without its end; raises `FrameError` unless all of it is right."""
    match = _REPLY.fullmatch(line)
    if match is None:
        has_suffix = b"#" in line or b"*" in line
        raise FrameError("wrong_check" if has_suffix else "unchecked", line)
    plain, sequence, sample, crc = match.groups()
    if binascii.crc_hqx(line[:-5], 0) != int(crc, 16):
        raise FrameError("wrong_check", line)
    return Checked(plain, int(sequence, 16), None if sample is None else _reading(sample))


def _reading(sample: bytes) -> Reading:
    mcu_ms, a, b, c, d = (int(sample[start : start + 4], 16) for start in range(0, 20, 4))
    return Reading(mcu_ms, (a, b, c, d))
