"""The rules of the latch file: its content, and the latches with which the daemon starts.

If the latch file cannot be read or cannot be written, the robot starts stopped until `clear`. Each
latch is written when it is set, so it does not matter how the process ends. This module is pure;
`latch_file.py` reads and writes the file.
"""

from __future__ import annotations

from typing import Any, Protocol

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.motion.lifecycle import number_after_restart, with_causes
from acsard.core.values import NS_PER_S, AcsardError, Event, Instant, Latch, Latches

FORMAT = 1
"""Version of the latch file's format. A file with another version counts as unreadable."""

MAX_BYTES = 65_536
"""Largest size of a latch file, bytes. A larger file counts as unreadable. Three latches and all
limits take about 1 kB."""

MAX_TEXT = 500
"""Largest number of characters of a name or a reason in the latch file. The rest is cut off."""

ANSWER_NS = NS_PER_S // 5
"""Longest time for which the answer to a stop waits for the latch file, ns. A longer wait would
make a client believe that the robot did not receive the stop."""

BY = "acsard"
"""Stands in place of a client's name in a stop that the daemon itself sets."""


EMPTY = ("earlier", ())
"""Name and value of the field `earlier` of a latch that has only one cause. Most latches have only
one, so the file leaves this field out."""


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
    content = _Content(FORMAT, robot, Latches(stop, fault, inactive, latches.lowered))
    return msgspec.json.format(msgspec.json.encode(_plain(content)), indent=2) + b"\n"


def decode(robot: str, data: bytes) -> Latches:
    """Return the latches in `data`, the content of the robot's latch file.

    Each latch is marked as kept over a restart. Raises `LatchFileError` for content that is
    damaged, of another version or of another robot. Every incomplete file counts as damaged,
    because a power cut may leave only a part of the file. A file with a missing or unknown field
    name counts as damaged too: otherwise one wrong letter in a name could make a stop disappear.
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
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise LatchFileError(f"it is damaged ({error})") from None
    if content.robot != robot:
        raise LatchFileError(f"it belongs to the robot {_safe(content.robot)!r:.60}")
    found = content.latches
    for latch in (found.stop, found.fault, found.inactive):
        if latch is not None and any(cause.earlier for cause in latch.earlier):
            # No daemon writes that, and the code below cannot process causes of any depth.
            raise LatchFileError("it is damaged (an earlier cause has causes of its own)")
    if _plain(content) != raw:
        raise LatchFileError("it is damaged (a field name is missing or unknown)")
    return found.after_restart()


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


def stopped(latches: Latches, why: str, now: Instant, by: str = BY, before: int = -1) -> Latches:
    """Return `latches` with a stop added. If they have a stop already, return them unchanged.

    Args:
        why: the reason of the stop.
        now: the time of the stop.
        by: the client that requested the stop, or `BY` for the daemon itself.
        before: the number of the previous stop, or -1 if there was none. The new number is higher.
    """
    if latches.stop is not None:
        return latches
    numbers = [latch.number for latch in (latches.fault, latches.inactive) if latch is not None]
    number = number_after_restart(max([*numbers, before]), now)
    return replace(latches, stop=Latch(number, now.wall_ns, by, why))


def doubted(latches: Latches, why: str, now: Instant) -> Latches:
    """Return the latches with which the robot starts if the latch file cannot be written.

    `latches` are those in the file, and `why` is the reason of the added stop. The previous process
    may have set latches that are not in the file. So the robot starts stopped, and each latch of
    the file gets a new number. A `clear` or `activate` with an old number then has no effect,
    because its sender may not know of the lost latches.
    """
    found = latches.fault, latches.inactive, latches.stop
    kept = max((latch.number for latch in found if latch), default=-1)
    number = number_after_restart(kept, now)
    fault, inactive, stop = (
        latch and replace(latch, number=number + place) for place, latch in enumerate(found)
    )
    return stopped(Latches(stop, fault, inactive, latches.lowered), why, now)


class LatchKeeper(Protocol):
    """The storage that keeps the latches over a restart.

    Of its methods, only `wait` waits for the disk.
    """

    def keep(self, latches: Latches) -> None:
        """Store these latches, which are now in force, in place of all earlier ones."""

    def holds(self, latches: Latches) -> bool:
        """Return whether these latches are stored. They then survive a kill of the process."""

    def wait(self, latches: Latches, seconds: float) -> None:
        """Block until these latches are stored, but at most `seconds` s."""

    def news(self) -> list[Event]:
        """Return the events of the storage since the last call, such as a failed write."""

    @property
    def trouble(self) -> str:
        """The reason why the latches would not survive a restart, in words; "" if they would."""


class Handover:
    """Hands the latches of the control loop to their keeper, and reports when they are stored.

    The robot stops immediately, but the answer to a stop waits until the stop would survive a kill
    of the process. After `ANSWER_NS` the answer is sent in any case. It then says that the stop is
    not stored yet.
    """

    def __init__(self, latches: Latches, keeper: LatchKeeper | None) -> None:
        """Begin with the latches with which the robot starts. The keeper has them already.

        If `keeper` is None, latches are not stored.
        """
        self.latches = latches
        self._keeper = keeper

    def take(self, latches: Latches) -> None:
        """Pass these latches to the keeper, unless the last call passed the same object."""
        if latches is not self.latches:
            self.latches = latches
            if self._keeper is not None:
                self._keeper.keep(latches)

    def take_stops(self, latches: Latches, by: list[str], now: Instant) -> None:
        """Pass these latches to the keeper, with a new stop if `by` is not empty.

        `by` contains the names of the clients whose stops no control step has processed, one name
        for each stop. The new stop names all these clients. Its number is new, so a `clear` of an
        earlier stop does not release it.
        """
        for name in reversed(by):
            last, text = latches.stop, f"stopped by {name or 'request'}"
            before = -1 if last is None else last.number
            latches = stopped(replace(latches, stop=None), text, now, name, before)
            assert latches.stop is not None
            latches = replace(latches, stop=with_causes(latches.stop, last))
        self.take(latches)

    @property
    def held(self) -> bool:
        """Whether all latches that must be stored are stored, so that they survive a kill.

        Without a keeper no latch must be stored, so this is always true.
        """
        return self._keeper is None or self._keeper.holds(self.latches)

    def wait(self) -> None:
        """Block until the latches are stored, but at most `ANSWER_NS`.

        Call this only after the last control step, because it would delay a step.
        """
        if self._keeper is not None:
            self._keeper.wait(self.latches, ANSWER_NS / NS_PER_S)

    def news(self) -> list[Event]:
        return [] if self._keeper is None else self._keeper.news()

    @property
    def trouble(self) -> str | None:
        """The reason why the latches would not survive a restart, in words; "" if they would.

        None if there is no keeper, so that latches are never stored.
        """
        return None if self._keeper is None else self._keeper.trouble


def _plain(content: Any) -> Any:
    """Return the content as JSON data, without the field `earlier` of latches with one cause."""
    match msgspec.to_builtins(content):
        case dict() as fields:
            pairs = fields.items()
            return {name: _plain(value) for name, value in pairs if (name, value) != EMPTY}
        case tuple() as items:
            return [_plain(item) for item in items]
        case value:
            return value


def _with_safe_text(latch: Latch) -> Latch:
    return replace(latch, by=_safe(latch.by), why=_safe(latch.why))


def _safe(text: str) -> str:
    return text[:MAX_TEXT].encode(errors="replace").decode()
