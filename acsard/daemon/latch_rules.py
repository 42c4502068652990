"""The rules of the latch file: its content, and the latches with which the robot starts.

A latch is a stop, a fault or "inactive", which lasts until a person releases it. If the latch file
cannot be read or written, the robot starts stopped, until a `clear` releases the stop. The daemon
writes each latch to the file when the latch is set, so it does not matter how the process ends.
This module is pure; `latch_file.py` reads and writes the file.
"""

from __future__ import annotations

from typing import Any, Protocol

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.motion.lifecycle import number_after_restart, with_causes
from acsard.core.values import NS_PER_S, AcsardError, Event, Instant, Latch, Latches
from acsard.host.errors import MSGSPEC_ERRORS

FORMAT = 1
"""Version of the latch file's format. A file with another version counts as unreadable."""

MAX_BYTES = 65_536
"""Largest size of a latch file, bytes. A larger file counts as unreadable. Three latches take
about 1 kB."""

MAX_NUMBER = 1 << 52
"""Largest latch number that is accepted in the file. Later latches get higher numbers, and a
`clear` can name only numbers below 2^53."""

MAX_TEXT_LENGTH = 500
"""Largest length of a name or a reason in the latch file, characters. The rest is cut off."""

MAX_ANSWER_DELAY_NS = NS_PER_S // 5
"""Longest time for which the answer to a stop waits for the latch file, ns. A longer wait would
make a client believe that the robot did not receive the stop."""

DAEMON_NAME = "acsard"
"""Name of the sender in a stop that the daemon itself sets."""


NO_EARLIER = ("earlier", ())
"""Name and value of the field `earlier` of a latch with only one cause. The file leaves this field
out, because most latches have only one cause."""


class LatchFileError(AcsardError):
    """The content of a latch file is damaged, of another version or of another robot."""


class _Content(Struct, frozen=True):
    format: int
    robot: str
    latches: Latches


def encode(robot: str, latches: Latches) -> bytes:
    """Return the content of a robot's latch file, as indented JSON.

    `robot` is the robot's id. Names and reasons longer than `MAX_TEXT_LENGTH` are cut off.
    """
    stop, fault, inactive = (
        None if latch is None else latch.each(_with_safe_text)
        for latch in (latches.stop, latches.fault, latches.inactive)
    )
    content = _Content(FORMAT, robot, Latches(stop, fault, inactive))
    return msgspec.json.format(msgspec.json.encode(_plain(content)), indent=2) + b"\n"


def decode(robot: str, data: bytes) -> Latches:
    """Return the latches in `data`, the content of the latch file of the robot with the id `robot`.

    In each latch, `kept` is true, because the latch is from before the present run of the daemon.
    Raises `LatchFileError` for content that is damaged, of another version or of another robot. An
    incomplete file counts as damaged, because a power cut may leave only a part of the file. A file
    with a missing or unknown field name counts as damaged too. Otherwise one wrong letter in a name
    could make a stop disappear.
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
        content = msgspec.convert(raw, _Content)
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
    if _plain(content) != raw:
        raise LatchFileError("it is damaged (a field name is missing or unknown)")
    return latches.after_restart()


def at_start(why: str) -> str:
    """Return the reason of a stop that the daemon itself sets at its start, in words.

    `why` is the cause, for example that the latch file cannot be read.
    """
    return f"stopped when the daemon started, because {why}"


def unreadable(where: str, reason: str) -> str:
    """Return the reason of the stop that the daemon sets if it cannot read the latch file.

    `where` is the path of the file. `reason` says why it cannot be read.
    """
    return at_start(f"{where} cannot be read: {reason}; a stop may have been lost")


def unwritable(where: str, reason: str) -> str:
    """Return the message for a latch file that cannot be written.

    `where` is the path of the file. `reason` says why it cannot be written.
    """
    return (
        f"a stop would not survive a restart: the latch file ({where}) cannot be written: {reason}"
    )


def stopped(
    latches: Latches, why: str, now: Instant, by: str = DAEMON_NAME, before: int = -1
) -> Latches:
    """Return `latches` with a stop added, or unchanged if `latches` already contains a stop.

    Args:
        latches: the latches in force.
        why: the reason of the stop, in words.
        now: the time of the stop.
        by: the name of the client that requested the stop, or `DAEMON_NAME` for the daemon itself.
        before: the number of the previous stop, or -1 without a previous stop. The new stop gets a
            higher number.
    """
    if latches.stop is not None:
        return latches
    numbers = [latch.number for latch in (latches.fault, latches.inactive) if latch is not None]
    number = number_after_restart(max([*numbers, before]), now)
    return replace(latches, stop=Latch(number, now.wall_ns, by, why))


def after_failed_write(latches: Latches, why: str, now: Instant) -> Latches:
    """Return the latches with which the robot starts if the latch file cannot be written.

    The previous process may have set latches that are not in the file, so the robot starts stopped.
    Each latch of the file gets a new number, so that a `clear` or `activate` with an old number has
    no effect. Its sender may not know of the lost latches.

    Args:
        latches: the latches in the file.
        why: the reason of the stop that is added if `latches` contains no stop, in words.
        now: the time of the start.
    """
    old_latches = latches.fault, latches.inactive, latches.stop
    last_number = max((latch.number for latch in old_latches if latch), default=-1)
    number = number_after_restart(last_number, now)
    fault, inactive, stop = (
        latch and replace(latch, number=number + place) for place, latch in enumerate(old_latches)
    )
    return stopped(Latches(stop, fault, inactive), why, now)


class LatchKeeper(Protocol):
    """The storage that keeps the latches (stop, fault, "inactive") over a restart of the daemon.

    Only the method `wait` waits for the disk.
    """

    def keep(self, latches: Latches) -> None:
        """Store the latches that are now in force, in place of all earlier ones.

        A later call may come before these latches are stored. They are then not stored at all.
        """

    def holds(self, latches: Latches) -> bool:
        """Return whether these latches are stored, so that they survive a kill of the process.

        `latches` must be the object that was passed to `keep`. An equal copy does not count.
        """

    def wait(self, latches: Latches, seconds: float) -> None:
        """Block until these latches are stored or cannot be stored, but at most `seconds` s."""

    def take_events(self) -> list[Event]:
        """Return the events of the storage since the last call, such as a failed write."""

    @property
    def trouble(self) -> str:
        """Reason why the latches would not survive a restart, in words, or "" if they would."""


class Handover:
    """Passes the latches of the control loop to their storage, and says whether they are stored.

    The robot stops immediately, but the answer to a stop waits until the stop would survive a kill
    of the process. After `MAX_ANSWER_DELAY_NS` the answer is sent in any case. It then says that
    the stop is not stored yet.
    """

    def __init__(self, latches: Latches, keeper: LatchKeeper | None) -> None:
        """Record `latches`, with which the robot starts. They must be stored already.

        `keeper` is the storage of the latches. If it is None, latches are never stored.
        """
        self.latches = latches
        self._keeper = keeper

    def take(self, latches: Latches) -> None:
        """Pass the latches in force to the storage, unless the last call passed the same object."""
        if latches is not self.latches:
            self.latches = latches
            if self._keeper is not None:
                self._keeper.keep(latches)

    def take_stops(self, latches: Latches, by: list[str], now: Instant) -> None:
        """Add unprocessed stops to `latches`, and pass the result to the storage.

        A stop is unprocessed if it arrived after the last control step, or if that step failed. The
        result contains one new stop, which names the clients in `by`, up to the limit
        `lifecycle.MAX_CLIENTS`. This stop has a new number, so a `clear` of an earlier stop does
        not release it.

        Args:
            latches: the latches in force.
            by: the name of the client for each unprocessed stop. If the list is empty, no stop is
                added.
            now: the time of the new stop.
        """
        for name in reversed(by):
            last, text = latches.stop, f"stopped by {name or 'request'}"
            before = -1 if last is None else last.number
            latches = stopped(replace(latches, stop=None), text, now, name, before)
            assert latches.stop is not None
            latches = replace(latches, stop=with_causes(latches.stop, last))
        self.take(latches)

    @property
    def is_stored(self) -> bool:
        """Whether the latches are stored, so that they survive a kill of the process.

        If this daemon stores no latches, this is always True.
        """
        return self._keeper is None or self._keeper.holds(self.latches)

    def wait(self) -> None:
        """Block until the latches are stored, but at most `MAX_ANSWER_DELAY_NS`.

        Call this method only after the last control step, because waiting would delay a step.
        """
        if self._keeper is not None:
            self._keeper.wait(self.latches, MAX_ANSWER_DELAY_NS / NS_PER_S)

    def take_events(self) -> list[Event]:
        return [] if self._keeper is None else self._keeper.take_events()

    @property
    def trouble(self) -> str | None:
        """Reason why the latches would not survive a restart, in words, or "" if they would.

        None means that this daemon never stores latches, because it runs without a latch file.
        """
        return None if self._keeper is None else self._keeper.trouble


def _plain(content: Any) -> Any:
    """Return the content of a latch file as JSON data.

    The field `earlier` contains the earlier causes of a latch. It is left out if it is empty.
    """
    match msgspec.to_builtins(content):
        case dict() as fields:
            pairs = fields.items()
            return {name: _plain(value) for name, value in pairs if (name, value) != NO_EARLIER}
        case tuple() as items:
            return [_plain(item) for item in items]
        case value:
            return value


def _with_safe_text(latch: Latch) -> Latch:
    return replace(latch, by=_safe(latch.by), why=_safe(latch.why))


def _safe(text: str) -> str:
    return text[:MAX_TEXT_LENGTH].encode(errors="replace").decode()
