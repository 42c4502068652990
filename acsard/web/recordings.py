"""Lists and finds the recordings in the directory of the black box."""

from __future__ import annotations

import asyncio
import calendar
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.threads import in_thread
from acsard.recording.directory import NAME_TIME_FORMAT, is_being_recorded
from acsard.recording.file import listed
from acsard.web.answers import READ_TIMEOUT_S, TroubleError
from acsard.web.callers import RequestRefusedError, is_loopback
from acsard.web.followed_robot import FollowedRobot
from acsard.web.tasks import shared

MIN_LIST_INTERVAL_NS = NS_PER_S // 4


class Recording(Struct, frozen=True):
    """One recording of the black box."""

    name: str
    begin: Annotated[float | None, Meta(description="s since 1970; null if unknown")]
    seconds: Annotated[float | None, Meta(description="until it was last written; null if unknown")]
    bytes: int
    being_recorded: bool


class BlackBox:
    """The recordings of the daemon of the page's robot.

    Every method raises `TroubleError` if they cannot be read, for example because they are
    elsewhere.
    """

    def __init__(self, robot: FollowedRobot) -> None:
        self._robot = robot
        self._listing: asyncio.Task[list[Recording]] | None = None
        self._listed_ns = 0  # start of the task `_listing`

    async def rows(self) -> list[Recording]:
        """Return all recordings, oldest first, as they were `MIN_LIST_INTERVAL_NS` ago or later."""
        # All requests within `MIN_LIST_INTERVAL_NS` share one list. Otherwise, a client that
        # requests the list all the time would use so much processor time that the stops of other
        # clients are late.
        place, now_ns = self._place(), clock.mono_ns()
        old = now_ns - self._listed_ns > MIN_LIST_INTERVAL_NS
        if self._listing is None or (old and self._listing.done()):
            self._listing = shared(in_thread(lambda: rows(place), READ_TIMEOUT_S))
            self._listed_ns = now_ns
        try:
            return await asyncio.shield(self._listing)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None

    async def find(self, name: str) -> Path:
        """Return the path of a recording. Raises `RequestRefusedError` if it does not exist."""
        place = self._place()

        def find_file() -> Path | None:
            return next((path for path in _files(place) if path.name == name), None)

        try:
            path = await in_thread(find_file, READ_TIMEOUT_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        if path is None:
            text = "this recording does not exist; GET /api/recordings lists them"
            raise RequestRefusedError("path", text)
        return path

    def _place(self) -> Path:
        host = self._robot.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(
                404,
                "the recordings are on the robot, but this page's server runs on another machine: "
                "open the page that the robot serves",
            )
        if not self._robot.about.recordings:
            raise TroubleError(
                404,
                "the daemon records nothing, because record.directory is not set: set it and "
                "restart the daemon",
            )
        return Path(self._robot.about.recordings)


def rows(directory: Path) -> list[Recording]:
    """Return all recordings in a directory, oldest first. Raises `OSError`."""
    recordings = []
    for path in _files(directory):
        # The daemon may delete a file meanwhile.
        with suppress(FileNotFoundError):
            recordings.append(_row(path))
    return recordings


def _files(directory: Path) -> list[Path]:
    try:
        return listed(directory)
    except FileNotFoundError:
        return []


def _row(path: Path) -> Recording:
    status, begin = path.stat(), _begun(path)
    # The clock may have been set meanwhile.
    seconds = None if begin is None else max(0.0, round(status.st_mtime - begin, 3))
    recorded = is_being_recorded(path, time.time())
    return Recording(path.name, begin, seconds, status.st_size, recorded)


def _begun(path: Path) -> float | None:
    try:
        begun = time.strptime(path.name.partition("-")[2].partition(".")[0], NAME_TIME_FORMAT)
    except ValueError:
        return None
    return float(calendar.timegm(begun))


def _unread(place: Path, error: Exception) -> TroubleError:
    words = getattr(error, "strerror", None) or "the disk does not answer; try again"
    return TroubleError(503, f"cannot read {place}: {words}")
