"""Lists and finds the recordings in the directory of the black box."""

from __future__ import annotations

import calendar
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, TypeVar

from msgspec import Meta, Struct

from acsard.host.threads import in_thread
from acsard.recording.directory import NAME_TIME_FORMAT, is_being_recorded
from acsard.recording.file import first_head, listed
from acsard.web.answers import TroubleError
from acsard.web.callers import RequestRefusedError, is_loopback
from acsard.web.followed_robot import FollowedRobot

# For a disk.
READ_TIMEOUT_S = 10.0

T = TypeVar("T")

ELSEWHERE = "open the page that the robot serves"


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

    async def rows(self) -> list[Recording]:
        """Return all recordings, oldest first."""
        return await self._read(rows)

    async def find(self, name: str) -> Path:
        """Return the path of a recording. Raises `RequestRefusedError` if it does not exist."""
        paths = await self._read(list)
        path = next((path for path in paths if path.name == name), None)
        if path is None:
            text = "this recording does not exist; GET /api/recordings lists them"
            raise RequestRefusedError("path", text)
        return path

    async def _read(self, read: Callable[[Sequence[Path]], list[T]]) -> list[T]:
        robot, directory = self._robot, Path(self._robot.about.recordings)
        host = robot.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(404, f"the recordings are on another machine: {ELSEWHERE}")
        if not robot.about.recordings:
            return []  # the daemon records nothing
        try:
            return await in_thread(lambda: read(files(directory, robot.id)), READ_TIMEOUT_S)
        except (OSError, TimeoutError) as error:
            words = getattr(error, "strerror", None) or "the disk does not answer; try again"
            raise TroubleError(503, f"cannot read {directory}: {words}") from None


def files(directory: Path, robot: str) -> list[Path]:
    """Return the recordings of a robot in a directory, oldest first.

    Raises `TroubleError` if another robot has recorded there, and `OSError`.
    """
    try:
        paths = listed(directory)
    except FileNotFoundError:
        return []
    head = first_head(paths[-1]) if paths else None
    # A daemon behind a router on this machine may record on a machine of its own.
    if head is not None and head.robot != robot:
        raise TroubleError(404, f"{directory} has the recordings of {head.robot}: {ELSEWHERE}")
    return paths


def rows(paths: Iterable[Path]) -> list[Recording]:
    """Return what is known of each recording. Raises `OSError`."""
    recordings = []
    for path in paths:
        # The daemon may delete a file meanwhile.
        with suppress(FileNotFoundError):
            recordings.append(_row(path))
    return recordings


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
