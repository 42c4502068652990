"""The black box as the page lists it: what is in the directory, by name, and nothing else."""

from __future__ import annotations

import calendar
import time
from pathlib import Path

from msgspec import Struct

from acsard.host.errors import RecordingError
from acsard.record.closing import closing, how_it_ends
from acsard.record.directory import PART, STAMP, listed
from acsard.values import NS_PER_S


class Listed(Struct, frozen=True):
    """One recording."""

    name: str
    begin: float | None
    """Seconds since 1970."""
    seconds: float | None
    """How long it is; None where it has no end yet."""
    bytes: int
    events: str
    """What happened, in a few words."""


def rows(directory: Path) -> list[Listed]:
    """All of them, oldest first; raises `OSError`."""
    return [_row(path) for path in listed(directory)]


def named(directory: Path, name: str) -> Path | None:
    """The file of this name, if it is one of them; raises `OSError`."""
    return next((path for path in listed(directory) if path.name == name), None)


def stamp(path: Path) -> tuple[int, int]:
    """Another when there is more in it; raises `OSError`."""
    seen = path.stat()
    return seen.st_mtime_ns, seen.st_size


def _row(path: Path) -> Listed:
    size = path.stat().st_size
    if path.name.endswith(PART):
        return Listed(path.name, _begun(path), None, size, "being written, or cut")
    try:
        last = closing(path)
    except RecordingError as error:
        return Listed(path.name, _begun(path), None, size, str(error))
    if last is None:
        return Listed(path.name, _begun(path), None, size, "no end: cut")
    events = "; ".join(filter(None, [last.said, how_it_ends(last.cut, last.why)]))
    seconds = (last.last_ns - last.wall_ns) / NS_PER_S
    return Listed(path.name, last.wall_ns / NS_PER_S, round(seconds, 3), size, events)


def _begun(path: Path) -> float | None:
    """By its name."""
    try:
        told = time.strptime(path.name.partition("-")[2].partition(".")[0], STAMP)
    except ValueError:
        return None
    return float(calendar.timegm(told))
