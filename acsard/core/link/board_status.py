"""Decodes the board's status line: emergency stop, bumpers, motor driver, battery, temperature.

    !status estop=ok bumpers=..X. driver=ok volts=24.31 amps=-1.20 charge=87% temp=41.5*HHHH

Fields are optional, in any order, each at most once, and one invalid field makes the line invalid.
The line is sent in addition to replies. The words of an input differ in many bits, and a number has
fixed decimals or ends with `%`, so damage is detectable. `*` and the CRC-16/XMODEM of all before it
may end the line, and must on a checked link.
"""

from __future__ import annotations

import binascii
import re
from functools import lru_cache

from msgspec import Struct
from msgspec.structs import astuple

from acsard.core.link.codec import FrameError
from acsard.core.values import NS_PER_S, Ns

STATUS = b"!status"  # no other line begins like this

IDENTITY = b"!acsard-mcu "  # acsard's firmware, after booting and as the answer to `?`

# Time with the link up and without late steps, in which a board reports each field at least once.
# Until then, a pressed emergency stop stays latched while its cable is plugged in again.
FORGET_NS = 3 * NS_PER_S

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
    """The fields of one status line; None if it does not contain the field."""

    estop: bool | None = None
    bumpers: tuple[bool, ...] | None = None
    driver_fault: bool | None = None
    volts: float | None = None  # V
    amps: float | None = None  # A, negative while the battery discharges
    charge: float | None = None  # 0 to 1
    temperature: float | None = None  # degrees Celsius


def merged(status: BoardStatus, newer: BoardStatus) -> BoardStatus:
    """Return `status` with those fields of `newer` that are not None."""
    pairs = zip(astuple(status), astuple(newer), strict=True)
    return BoardStatus(*[old if new is None else new for old, new in pairs])


class StatusReports(Struct):
    """The fields that the board on this port has reported.

    Another board may answer after the port was opened again, so the fields that only the previous
    one reported are forgotten after `FORGET_NS`. A board that restarts has the same inputs: a field
    that it no longer reports is a fault.
    """

    new: list[tuple[Ns, BoardStatus]] = []  # of the last update, with arrival
    last: BoardStatus = BoardStatus()  # last value of each field, until it is forgotten
    last_ns: Ns | None = None  # arrival of the last line
    forgot: bool = False  # in the last update
    # Both of these since the last opening, and how long the link was up: None after the fields of
    # another board were forgotten, and then `forget_other_board` has nothing to do.
    since_opening: tuple[BoardStatus, Ns | None] = (BoardStatus(), None)
    up_ns: Ns | None = 0
    checked_ns: Ns = 0

    def begin_update(self) -> None:
        self.forgot = False
        if self.new:
            self.new = []

    def reopen(self) -> None:
        self.since_opening, self.up_ns = (BoardStatus(), None), 0

    def take(self, line: bytes, check: bool, at_ns: Ns) -> None:
        """Take a status line, as `decode_status`. Raises `FrameError`."""
        status = decode_status(line, check)
        self.last, self.last_ns = merged(self.last, status), at_ns
        self.since_opening = merged(self.since_opening[0], status), at_ns
        self.new.append((at_ns, status))

    def forget_other_board(self, now_ns: Ns, up: bool, late: bool) -> None:
        """Forget the fields of another board, if the link was up long enough without late steps.

        Call it while `up_ns` is known.
        """
        assert self.up_ns is not None
        passed_ns, self.checked_ns = now_ns - self.checked_ns, now_ns
        self.up_ns = 0 if not up else self.up_ns + (0 if late else passed_ns)
        if self.up_ns >= FORGET_NS:
            self.up_ns, self.forgot = None, True
            self.last, self.last_ns = self.since_opening


def as_text(status: BoardStatus) -> dict[str, str]:
    """Return the fields that are not None as text, under names that users see ("motor_driver")."""
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
    """Return the fields of a status line without its line end. Raises `FrameError`.

    If `check` is true, the line needs a checksum; a wrong one is never valid.
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
