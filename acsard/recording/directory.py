"""The directory of recordings: begins files, and deletes the oldest ones.

    000012-20261121T070027Z.rec.zst

The number gives the order, even if the wall clock was set. All files together stay below
`record.megabytes`, and leave a part of the disk to other programs. If these fill it, the newest
`MIN_BYTES` stay nevertheless.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from acsard.core.config.settings import RECORD_VARIABLE, RecordConfig
from acsard.core.formatting import listed as listed_names
from acsard.core.formatting import many
from acsard.core.values import NS_PER_S, WallNs
from acsard.host.atomic_file import real_path, sync
from acsard.recording.file import SUFFIX, listed, number_of

FILE_MODE, DIRECTORY_MODE = 0o640, 0o750  # the group of the daemon's service may read

# Every user may read the files, but only root can enter `PRIVATE_STATE`. The page's service reads
# them through a read-only mount: its dynamic group has no name to give permissions to, and systemd
# 257 makes `nobody` the owner of state directories.
OPEN_FILE_MODE, OPEN_DIRECTORY_MODE = 0o644, 0o755

PRIVATE_STATE = Path("/var/lib/private")  # of services with a dynamic user; only root can enter it

MIN_BYTES = 10_000_000  # also the smallest `record.megabytes`

FILES = 50  # that fit into the limit: one of them at most is deleted before it has to be

SPARE_FRACTION, MAX_SPARE_BYTES = 0.05, 1_000_000_000  # of the disk, for other programs

BEING_RECORDED_S = 10.0  # a daemon writes once a second

NAME_TIME_FORMAT = "%Y%m%dT%H%M%SZ"  # UTC, of the beginning

MAX_NAMES = 5  # of deleted files in an event


def is_being_recorded(path: Path, now_s: float) -> bool:
    """Return whether a daemon is still writing to a file, `now_s` after 1970. Raises `OSError`."""
    return abs(now_s - path.stat().st_mtime) < BEING_RECORDED_S


class RecordingDirectory:
    """The directory of a running daemon. Every method may raise `OSError`."""

    def __init__(self, settings: RecordConfig) -> None:
        self._path = Path(settings.directory)
        self._limit = int(settings.megabytes * 1e6)
        self.file_bytes = self._limit // FILES  # at which a file should end
        self._service = os.environ.get(RECORD_VARIABLE) == settings.directory

    def begin(self, wall_ns: WallNs) -> BinaryIO:
        """Create and return the next file."""
        is_open = self._service and real_path(self._path, new=True).is_relative_to(PRIVATE_STATE)
        if not self._path.is_dir():
            self._path.mkdir(parents=True)
            self._path.chmod(DIRECTORY_MODE)  # the umask may have removed bits of the mode
        if is_open:
            # The directory may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                self._path.chmod(OPEN_DIRECTORY_MODE)
        number = 1 + max([number_of(path) or 0 for path in listed(self._path)], default=0)
        stamp = time.strftime(NAME_TIME_FORMAT, time.gmtime(wall_ns // NS_PER_S))
        path = self._path / f"{number:06}-{stamp}{SUFFIX}"
        mode = OPEN_FILE_MODE if is_open else FILE_MODE
        file = path.open("xb")
        try:
            os.fchmod(file.fileno(), mode)
            sync(self._path)  # the name, too, must reach the disk
        except OSError:
            file.close()
            path.unlink(missing_ok=True)
            raise
        return file

    def make_room(self) -> str:
        """Delete the oldest files; return a text about it if the disk is the reason, or "".

        The newest file stays, because the daemon may be writing it.
        """
        sizes: dict[Path, int] = {}
        if not self._path.is_dir():
            return ""
        for path in listed(self._path):
            with suppress(FileNotFoundError):  # another process has just removed it
                sizes[path] = path.stat().st_size
        disk = os.statvfs(self._path)
        own, free = sum(sizes.values()), disk.f_bavail * disk.f_frsize
        spare = int(min(disk.f_blocks * disk.f_frsize * SPARE_FRACTION, MAX_SPARE_BYTES))
        # Some file systems do not report their size.
        room = own + free - spare if disk.f_blocks else self._limit
        most = min(self._limit, max(room, MIN_BYTES)) - self.file_bytes
        deleted = []
        for path in list(sizes)[:-1]:
            if own <= most:
                break
            # The file may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                path.unlink()
                own -= sizes[path]
                deleted.append(path.name)
        if not deleted or room >= self._limit:
            return ""
        return (
            f"{many(len(deleted), 'recording')} deleted ({listed_names(deleted, MAX_NAMES)}): only "
            f"{free / 1e6:.1f} MB of the disk were free, and recordings leave {spare / 1e6:.1f} MB "
            "to other programs; remove other files from the disk"
        )
