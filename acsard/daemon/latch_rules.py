"""The rules of the latch file: its content, and the latches with which the robot starts.

A latch is a stop, a fault or "inactive", until a person releases it. If the file cannot be read or
written, the robot starts stopped until `clear`. A latch is written when it is set, so it does not
matter how the process ends. This module is pure.
"""

from __future__ import annotations

from typing import Any, Protocol

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.codes import CODES, Reason, reason
from acsard.core.motion.lifecycle import (
    NAMELESS,
    latch_of,
    number_after_restart,
    with_causes,
)
from acsard.core.values import NS_PER_S, AcsardError, Event, Instant, Latch, Latches
from acsard.host.errors import MSGSPEC_ERRORS

FORMAT = 2  # another version is unreadable

MAX_BYTES = 65_536  # a larger file is unreadable; three latches take about 1 kB

MAX_NUMBER = 1 << 52  # later latches get higher ones, and `clear` can name only those below 2^53

MAX_TEXT_LENGTH = 500  # characters of a name or a reason

# The answer to a stop waits for the file no longer than this, or the client would believe that the
# robot did not receive its stop.
MAX_ANSWER_DELAY_NS = NS_PER_S // 5

DAEMON_NAME = "acsard"  # sender of a stop that the daemon itself sets


class LatchFileError(AcsardError):
    """The content of a latch file is damaged, of another version or of another robot."""


class _Content(Struct, frozen=True):
    format: int
    robot: str
    latches: Latches


def encode(robot: str, latches: Latches) -> bytes:
    """Return the content of a robot's latch file, as indented JSON."""
    stop, fault, inactive = (
        None if latch is None else latch.each(_with_safe_text)
        for latch in (latches.stop, latches.fault, latches.inactive)
    )
    content = _Content(FORMAT, robot, Latches(stop, fault, inactive))
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def decode(robot: str, data: bytes) -> Latches:
    """Return the latches of a robot's file, all `kept` from before this run.

    A later version may have written it: fields that it added are ignored, and a cause that it added
    still holds the robot. Raises `LatchFileError` for other robots, for a format or a kind of latch
    that this version does not know, and for damage: a power cut may leave a part, and one wrong
    letter in a field's name must not make a stop disappear.
    """
    if not data.strip(b"\0 \r\n"):
        raise LatchFileError("it is empty")
    try:
        raw = msgspec.json.decode(data)
        number = raw.get("format") if isinstance(raw, dict) else None
        if type(number) is int and number != FORMAT:
            raise LatchFileError(
                f"another version of acsard wrote the file (format {number}, but this daemon reads "
                f"format {FORMAT})"
            )
        content = msgspec.convert(_with_known_codes(raw), _Content)
    except MSGSPEC_ERRORS as error:
        raise LatchFileError(f"it is damaged ({error})") from None
    if content.robot != robot:
        raise LatchFileError(f"it belongs to the robot {_safe(content.robot)!r:.60}")
    latches = content.latches
    for latch in (latches.stop, latches.fault, latches.inactive):
        if latch is None:
            continue
        if any(cause.earlier for cause in latch.earlier):
            # No daemon writes such a file, and the code below cannot process causes that are nested
            # more deeply.
            raise LatchFileError("it is damaged (an earlier cause has causes of its own)")
        for cause in (latch, *latch.earlier):
            # A `clear` could not name a number outside this range, and messages have no integers
            # above 64 bits.
            if not (0 <= cause.number <= MAX_NUMBER and abs(cause.at_ns) < 1 << 63):
                raise LatchFileError("it is damaged (a number or a time is out of range)")
    _require_names(content, raw)
    for name in raw["latches"].keys() - set(Latches.__struct_fields__):
        if raw["latches"][name]:
            raise LatchFileError(f"another version of acsard has latched {_safe(name)!r:.60}")
    return latches.after_restart()


def at_start(why: str) -> Reason:
    """Return the reason of a stop that the daemon itself sets at its start."""
    return reason("stopped_at_start", cause=why)


def unreadable(where: str, problem: str) -> Reason:
    """Return the reason of the stop for an unreadable file."""
    return at_start(f"{where} cannot be read: {problem}; a stop may have been lost")


def unwritable(where: str, reason: str) -> str:
    """Return the message for a file that cannot be written."""
    return (
        f"a stop would not survive a restart: the latch file ({where}) cannot be written: {reason}"
    )


def stopped(
    latches: Latches, why: Reason, now: Instant, by: str = DAEMON_NAME, before: int = -1
) -> Latches:
    """Return `latches` with a stop, unless they have one.

    It is numbered above `before`, the previous stop or -1.
    """
    if latches.stop is not None:
        return latches
    numbers = [latch.number for latch in (latches.fault, latches.inactive) if latch is not None]
    number = number_after_restart(max([*numbers, before]), now)
    return replace(latches, stop=latch_of(number, now.wall_ns, by, why))


def after_failed_write(latches: Latches, why: Reason, now: Instant) -> Latches:
    """Return the latches with which the robot starts if the file cannot be written: stopped.

    The previous process may have set others. All get new numbers, so that a `clear` or `activate`
    of a client that does not know the lost ones has no effect.
    """
    old_latches = latches.fault, latches.inactive, latches.stop
    last_number = max((latch.number for latch in old_latches if latch), default=-1)
    number = number_after_restart(last_number, now)
    fault, inactive, stop = (
        latch and replace(latch, number=number + place) for place, latch in enumerate(old_latches)
    )
    return stopped(Latches(stop, fault, inactive), why, now)


class LatchKeeper(Protocol):
    """The storage of the latches over a restart; only `wait` waits for the disk."""

    def keep(self, latches: Latches) -> None:
        """Store the latches in force; a later call may come before they are stored."""

    def holds(self, latches: Latches) -> bool:
        """Return whether this object of `keep`, not a copy, would survive a kill of the process."""

    def wait(self, latches: Latches, seconds: float) -> None:
        """Block until these latches are stored or cannot be stored, at most `seconds`."""

    def take_events(self) -> list[Event]:
        """Return the events since the last call, such as a failed write."""

    @property
    def trouble(self) -> str:
        """Why the latches would not survive a restart, or ""."""


class Handover:
    """Passes the latches of the control loop to their storage.

    The robot stops immediately, but the answer to a stop waits until it would survive a kill. After
    `MAX_ANSWER_DELAY_NS` it is sent anyway, and says that the stop is not stored.
    """

    def __init__(self, latches: Latches, keeper: LatchKeeper | None) -> None:
        # `latches` are stored already. Without a `keeper`, no latches are stored.
        self.latches = latches
        self._keeper = keeper

    def take(self, latches: Latches) -> None:
        """Pass the latches in force on, unless the last call had the same object."""
        if latches is not self.latches:
            self.latches = latches
            if self._keeper is not None:
                self._keeper.keep(latches)

    def take_stops(self, latches: Latches, by: list[str], now: Instant) -> None:
        """Add one stop for the unprocessed stops of these clients, and pass the latches on.

        They came after the last step, or it failed. The new number keeps a `clear` of an earlier
        stop from releasing it.
        """
        for name in reversed(by):
            last, why = latches.stop, reason("stopped", by=name or NAMELESS)
            before = -1 if last is None else last.number
            latches = stopped(replace(latches, stop=None), why, now, name, before)
            assert latches.stop is not None
            latches = replace(latches, stop=with_causes(latches.stop, last))
        self.take(latches)

    @property
    def is_stored(self) -> bool:
        """Whether the latches would survive a kill, or this daemon stores none."""
        return self._keeper is None or self._keeper.holds(self.latches)

    def wait(self) -> None:
        """Block at most `MAX_ANSWER_DELAY_NS` until the latches are stored, after the last step."""
        if self._keeper is not None:
            self._keeper.wait(self.latches, MAX_ANSWER_DELAY_NS / NS_PER_S)

    def take_events(self) -> list[Event]:
        return [] if self._keeper is None else self._keeper.take_events()

    @property
    def trouble(self) -> str | None:
        """Why the latches would not survive a restart, or ""; None without a latch file."""
        return None if self._keeper is None else self._keeper.trouble


def _with_known_codes(raw: Any) -> Any:
    # The decoded JSON of a file, in which `Latch` can represent the code of each cause.
    match raw:
        case {"latches": dict() as latches}:
            known = {name: _with_known_code(latch) for name, latch in latches.items()}
            return raw | {"latches": known}
    return raw


def _with_known_code(raw: Any) -> Any:
    match raw:
        case {"earlier": list() as earlier}:
            raw = raw | {"earlier": [_known_cause(cause) for cause in earlier]}
    return _known_cause(raw)


def _known_cause(raw: Any) -> Any:
    match raw:
        case {"code": str(code), "why": str(why)} if code not in CODES:
            cause = reason("other_version", part=_safe(code), cause=why, named=code)
            return raw | {"code": cause.code, "why": cause.text, "part": cause.part}
    return raw


def _require_names(part: object, raw: Any) -> None:
    # A field with a default may be missing in messages, but not in the file.
    match part:
        case Struct():
            for name in part.__struct_fields__:
                if name not in raw:
                    raise LatchFileError(f"it is damaged (the field {name} is missing)")
                _require_names(getattr(part, name), raw[name])
        case tuple():
            for item, raw_item in zip(part, raw, strict=True):
                _require_names(item, raw_item)


def _with_safe_text(latch: Latch) -> Latch:
    return replace(latch, by=_safe(latch.by), why=_safe(latch.why))


def _safe(text: str) -> str:
    return text[:MAX_TEXT_LENGTH].encode(errors="replace").decode()
