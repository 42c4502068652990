"""The latches as bytes of a file, and the latches with which the daemon starts.

One rule decides the start: if the file cannot be read or cannot be written, the robot starts
stopped until `clear`. Whether the process before ended in order does not matter, since every
latch is written when it is set and not at the end. `latch_file.py` does the reading and writing.
"""

from __future__ import annotations

from typing import Protocol

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.values import NS_PER_S, AcsardError, Event, Instant, Latch, Latches

FORMAT = 1
"""Version of the file's layout. A file with another number counts as unreadable."""

MAX_BYTES = 65_536
"""Size of the largest file that is read. Three latches and all limits take about 1 kB."""

MAX_TEXT = 500
"""Characters of a name or a reason that are written: both may come from a stranger."""

ANSWER_NS = NS_PER_S // 5
"""Longest wait of an answer for the file. A slow disk must not make a stop look unheard."""

BY = "acsard"
"""Name under which the daemon stops the robot itself."""


class LatchFileError(AcsardError):
    """These bytes are not a latch file of this version."""


class _Content(Struct, frozen=True):
    format: int
    robot: str
    latches: Latches


def encode(robot: str, latches: Latches) -> bytes:
    """Return the content of the latch file, as indented JSON."""
    stop, fault, inactive = (
        None if latch is None else replace(latch, by=_safe(latch.by), why=_safe(latch.why))
        for latch in (latches.stop, latches.fault, latches.inactive)
    )
    content = _Content(FORMAT, robot, Latches(stop, fault, inactive, latches.lowered))
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def decode(robot: str, data: bytes) -> Latches:
    """Return the latches in this content, each marked as kept.

    Every prefix of a valid file is refused, since a power cut may leave one. So is a file with a
    missing or an unknown name in it: a damaged name must not make a stop disappear.

    Raises:
        LatchFileError: The content is damaged, of another version or of another robot.
    """
    if not data.strip(b"\0 \r\n"):
        raise LatchFileError("it is empty")
    try:
        raw = msgspec.json.decode(data)
        number = raw.get("format") if isinstance(raw, dict) else None
        if type(number) is int and number != FORMAT:
            raise LatchFileError(
                f"it is of another version (format {number}, but this daemon reads {FORMAT})"
            )
        content = msgspec.convert(raw, _Content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise LatchFileError(f"it is damaged ({error})") from None
    if content.robot != robot:
        raise LatchFileError(f"it belongs to the robot {_safe(content.robot)!r:.60}")
    if msgspec.to_builtins(content) != raw:
        raise LatchFileError("it is damaged (a name is missing or unknown)")
    return content.latches.after_restart()


def at_start(why: str) -> str:
    """Return the reason of a stop that the daemon itself sets at its start."""
    return f"stopped when the daemon started, because {why}"


def unreadable(where: str, reason: str) -> str:
    """Return the reason for a start whose latch file cannot be read."""
    return at_start(f"{where} cannot be read: {reason}; a stop may have been lost")


def unwritable(where: str, reason: str) -> str:
    """Return why a stop is not kept, for a latch file that cannot be written."""
    return f"a stop cannot be kept over a restart: {where}: {reason}"


def stopped(latches: Latches, why: str, now: Instant, by: str = BY) -> Latches:
    """Return these latches with a stop, by the daemon itself unless a client asked for it.

    A stop that is latched already stays.
    """
    if latches.stop is not None:
        return latches
    numbers = [latch.number for latch in (latches.fault, latches.inactive) if latch is not None]
    number = max(now.wall_ns // 1_000_000, *[n + 1 for n in numbers], 0)
    return replace(latches, stop=Latch(number, now.wall_ns, by, why))


class LatchKeeper(Protocol):
    """Keeps the latches over a restart; no method but `wait` waits for a disk."""

    def keep(self, latches: Latches) -> None:
        """Take the latches that are in force from now on; only the newest are written."""

    def holds(self, latches: Latches) -> bool:
        """Return whether a process that is killed now would start with these latches."""

    def wait(self, latches: Latches, seconds: float) -> None:
        """Wait until `holds` is true, at most this time."""

    def news(self) -> list[Event]:
        """Return the events since the last call."""

    @property
    def trouble(self) -> str:
        """Why the latches in force are not kept, in words; empty if they are."""


class Handover:
    """Hands the latches over to their keeper, and knows when a request may be answered.

    A stop that was answered survives a kill, so its answer waits for the file. The robot obeys in
    the meantime.
    """

    def __init__(self, latches: Latches, keeper: LatchKeeper | None) -> None:
        """Start with the latches that the keeper has read; None keeps nothing."""
        self.latches = latches
        self._keeper = keeper

    def take(self, latches: Latches) -> None:
        """Hand these latches over if they have changed."""
        if latches is not self.latches:
            self.latches = latches
            if self._keeper is not None:
                self._keeper.keep(latches)

    def take_stops(self, latches: Latches, by: list[str], now: Instant) -> None:
        """Hand these latches over with the stops of clients that no control step has served."""
        for name in by:
            latches = stopped(latches, f"stopped by {name or 'request'}", now, name)
        self.take(latches)

    @property
    def held(self) -> bool:
        """Return whether a process that is killed now would start with these latches."""
        return self._keeper is None or self._keeper.holds(self.latches)

    def wait(self) -> None:
        """Give the disk its time to take the latches; only on the way down."""
        if self._keeper is not None:
            self._keeper.wait(self.latches, ANSWER_NS / NS_PER_S)

    def news(self) -> list[Event]:
        """Return the events of the keeper since the last call."""
        return [] if self._keeper is None else self._keeper.news()

    @property
    def trouble(self) -> str | None:
        """Why the latches are not kept, in words; None where nothing is kept."""
        return None if self._keeper is None else self._keeper.trouble


def _safe(text: str) -> str:
    return text[:MAX_TEXT].encode(errors="replace").decode()
