"""The recordings in the black box's directory, as the page lists and sends them."""

from __future__ import annotations

import calendar
import time
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from acsard.core.values import NS_PER_S
from acsard.host.errors import RecordingError
from acsard.host.threads import in_thread
from acsard.recording.directory import PART, STAMP, is_being_recorded, listed
from acsard.recording.end_record import how_it_ends, read_end
from acsard.web.answers import READ_S, TroubleError
from acsard.web.callers import RefusedError, is_loopback
from acsard.web.robots import Robots


class Recording(Struct, frozen=True):
    """One recording of the black box."""

    name: str
    begin: Annotated[float | None, Meta(description="s since 1970; null if unknown")]
    seconds: Annotated[float | None, Meta(description="null without an end marker")]
    bytes: int
    events: Annotated[str, Meta(description="summary of the recorded events")]


class BlackBox:
    """The recordings of the page's robot. Every method raises `TroubleError`."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots

    async def rows(self) -> list[Recording]:
        """Return all recordings, oldest first."""
        place = self._place()
        try:
            return await in_thread(lambda: rows(place), READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None

    async def found(self, name: str) -> tuple[Path, tuple[int, int]]:
        """Return the path of a recording, and a value that changes when it grows or is replaced.

        Raises `RefusedError` if it is not listed.
        """
        place = self._place()

        def look() -> tuple[Path, tuple[int, int]] | None:
            path = next((path for path in _files(place) if path.name == name), None)
            if path is None:
                return None
            seen = path.stat()
            return path, (seen.st_mtime_ns, seen.st_size)

        try:
            found = await in_thread(look, READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        if found is None:
            text = "this recording does not exist; GET /api/recordings lists them"
            raise RefusedError("path", text)
        return found

    def _place(self) -> Path:
        host = self._robots.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(
                404,
                "the recordings are on the robot, but this page's server runs on another machine: "
                "open the page that the robot serves",
            )
        if not self._robots.about.recordings:
            raise TroubleError(404, "nothing is recorded, because record.directory is empty")
        return Path(self._robots.about.recordings)


def rows(directory: Path) -> list[Recording]:
    """Return all recordings of a directory, oldest first; raises `OSError`."""
    return [_row(path) for path in _files(directory)]


def _files(directory: Path) -> list[Path]:
    """Return the recordings, or none until the recorder has made its directory."""
    try:
        return listed(directory)
    except FileNotFoundError:
        return []


def _row(path: Path) -> Recording:
    size = path.stat().st_size
    if path.name.endswith(PART):
        words = "being recorded" if is_being_recorded(path, time.time()) else "no end: cut off"
        return Recording(path.name, _begun(path), None, size, words)
    try:
        last = read_end(path)
    except RecordingError as error:
        return Recording(path.name, _begun(path), None, size, str(error))
    if last is None:
        return Recording(path.name, _begun(path), None, size, "no end: cut")
    events = "; ".join(filter(None, [last.said, how_it_ends(last.cut, last.why)]))
    seconds = (last.last_ns - last.wall_ns) / NS_PER_S
    return Recording(path.name, last.wall_ns / NS_PER_S, round(seconds, 3), size, events)


def _begun(path: Path) -> float | None:
    """Return the start time in the file name, in seconds since 1970."""
    try:
        told = time.strptime(path.name.partition("-")[2].partition(".")[0], STAMP)
    except ValueError:
        return None
    return float(calendar.timegm(told))


def _unread(place: Path, error: Exception) -> TroubleError:
    words = getattr(error, "strerror", None) or "no answer in time"
    return TroubleError(503, f"cannot read {place}: {words}")
