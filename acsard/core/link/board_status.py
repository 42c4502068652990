"""Decodes the board's status line: emergency stop, bumpers, motor driver, battery, temperature.

An example of a status line is:

    !status estop=ok bumpers=..X. driver=ok volts=24.31 amps=-1.20 charge=87% temp=41.5*HHHH

Every field is optional. The fields may come in any order, and each at most once. The board sends
status lines in addition to its replies, never instead of a reply. A status line contains no wheel
speeds and does not count as a reply. One invalid field makes the line invalid. The format of the
values makes damage detectable:

- An input has two words, such as `pressed` and `ok`. They differ in many bits, so a few flipped
  bits cannot turn one word into the other.
- Each number has a fixed number of decimals or ends with `%`, so a truncated number is refused.

`*` and four hexadecimal digits may end the line: the CRC-16/XMODEM of all characters before `*`. On
a checked link (a link whose lines have checksums), the line must have this checksum.
"""

from __future__ import annotations

import binascii
import re
from functools import lru_cache

from msgspec import Struct
from msgspec.structs import astuple

from acsard.core.link.codec import FrameError

STATUS = b"!status"
"""First bytes of every status line. No other line begins like this: a reply begins with a letter,
and the line in which a board identifies itself begins with `!acsard-mcu`."""

_LINE = re.compile(STATUS + rb"((?: [a-z]+=[^ *]+)+)(?:\*([0-9A-F]{4}))?")

_FORMS = {
    b"estop": re.compile(rb"ok|pressed"),
    b"bumpers": re.compile(rb"[.X]{1,4}"),
    b"driver": re.compile(rb"ok|fault"),
    b"volts": re.compile(rb"[0-9]{1,2}\.[0-9]{2}"),
    b"amps": re.compile(rb"-?[0-9]{1,3}\.[0-9]{2}"),
    b"charge": re.compile(rb"(?:100|[0-9]{1,2})%"),
    b"temp": re.compile(rb"-?[0-9]{1,3}\.[0-9]"),
}


class BoardStatus(Struct, frozen=True):
    """The fields of one status line. A field that the line does not contain is None."""

    estop: bool | None = None
    """Whether the emergency stop is pressed."""
    bumpers: tuple[bool, ...] | None = None
    """Whether each bumper is pressed: 1 to 4 values, in the order in which the board sends them."""
    driver_fault: bool | None = None
    volts: float | None = None
    """Battery voltage, V."""
    amps: float | None = None
    """Battery current, A. It is negative while the battery discharges."""
    charge: float | None = None
    """State of charge of the battery, 0 to 1."""
    temperature: float | None = None
    """Temperature of the board, degrees Celsius."""


def merged(status: BoardStatus, newer: BoardStatus) -> BoardStatus:
    """Return a copy of `status`, updated with those fields of `newer` that are not None."""
    pairs = zip(astuple(status), astuple(newer), strict=True)
    return BoardStatus(*[old if new is None else new for old, new in pairs])


def as_text(status: BoardStatus) -> dict[str, str]:
    """Return the fields of `status` as text, under the names that users see.

    The result maps names such as "motor_driver" to words or numbers such as "fault" or "24.31". It
    does not contain the fields that are None.
    """
    bumpers = status.bumpers
    values = {
        "emergency_stop": _flag_text(status.estop, "pressed", "released"),
        "bumpers": None
        if bumpers is None
        else "".join("X" if bumper else "." for bumper in bumpers),
        "motor_driver": _flag_text(status.driver_fault, "fault", "ok"),
        "volts": None if status.volts is None else f"{status.volts:.2f}",
        "amperes": None if status.amps is None else f"{status.amps:.2f}",
        "charge": None if status.charge is None else f"{status.charge:.2f}",
        "temperature_c": None if status.temperature is None else f"{status.temperature:.1f}",
    }
    return {name: value for name, value in values.items() if value is not None}


# A board at rest repeats the same line, so the last lines are cached.
@lru_cache(8)
def decode_status(line: bytes, check: bool) -> BoardStatus:
    """Return the fields of a status line. Raise `FrameError` if the line is not valid.

    `line` begins with `!status` and has no line end. If `check` is true, a line without a checksum
    is not valid. A line with a wrong checksum is never valid.
    """
    match = _LINE.fullmatch(line)
    if match is None:
        raise FrameError("status_malformed", line)
    body, crc = match.groups()
    if crc is None:
        if check:
            raise FrameError("status_without_crc", line)
    elif binascii.crc_hqx(line[:-5], 0) != int(crc, 16):
        raise FrameError("status_crc_error", line)
    fields: dict[bytes, bytes] = {}
    for field in body.split():
        name, _, value = field.partition(b"=")
        form = _FORMS.get(name)
        if form is None or name in fields or form.fullmatch(value) is None:
            raise FrameError("status_malformed", line)
        fields[name] = value
    return BoardStatus(
        estop=_is(fields, b"estop", b"pressed"),
        bumpers=tuple([mark == 0x58 for mark in fields[b"bumpers"]])
        if b"bumpers" in fields
        else None,
        driver_fault=_is(fields, b"driver", b"fault"),
        volts=_number(fields, b"volts"),
        amps=_number(fields, b"amps"),
        charge=None if b"charge" not in fields else int(fields[b"charge"][:-1]) / 100,
        temperature=_number(fields, b"temp"),
    )


def _flag_text(value: bool | None, yes: str, no: str) -> str | None:
    return None if value is None else yes if value else no


def _is(fields: dict[bytes, bytes], name: bytes, word: bytes) -> bool | None:
    return fields[name] == word if name in fields else None


def _number(fields: dict[bytes, bytes], name: bytes) -> float | None:
    return float(fields[name]) if name in fields else None
