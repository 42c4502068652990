"""The recordings in the black box's directory, as the page lists them."""

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
    """One recording in the list."""

    name: str
    begin: float | None
    """Start time in seconds since 1970, or None if it is unknown."""
    seconds: float | None
    """Duration in seconds; None if the recording has no end marker."""
    bytes: int
    events: str
    """Short summary of the recorded events."""


def rows(directory: Path) -> list[Listed]:
    """Return all recordings, oldest first; raises `OSError`."""
    return [_row(path) for path in listed(directory)]


def named(directory: Path, name: str) -> Path | None:
    """Return the recording with this name, or None if it is not listed; raises `OSError`."""
    return next((path for path in listed(directory) if path.name == name), None)


def stamp(path: Path) -> tuple[int, int]:
    """Return a value that changes when the file grows or is replaced; raises `OSError`."""
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
    """Return the start time in the file name, in seconds since 1970."""
    try:
        told = time.strptime(path.name.partition("-")[2].partition(".")[0], STAMP)
    except ValueError:
        return None
    return float(calendar.timegm(told))
