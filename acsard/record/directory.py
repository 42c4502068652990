"""A directory of recordings, bounded in bytes, days and files kept.

    000012-20261121T070027Z.mcap.part   being written, or cut by a crash
    000012-20261121T070027Z.mcap        finished
    000012-20261121T070027Z.kept.mcap   finished, and something happened in it

The number gives the order, whatever the clocks said. What is kept goes last.
"""

from __future__ import annotations

import calendar
import fcntl
import math
import os
import stat
import time
from contextlib import suppress
from pathlib import Path

from acsard.config.settings import RECORD, RecordConfig
from acsard.host.errors import RecordingError
from acsard.record.file import MODE, About, Recording, Writing, rewrite

DIRECTORY_MODE = 0o750

OPEN_DIRECTORY_MODE, OPEN_MODE = 0o755, 0o644
"""Where the service records. Root alone gets to the directory around it, and the page, whose unit
has it mounted read-only. No group would do: a dynamic one has no name, and later systemds (257)
keep a state directory as nobody's on the disk."""

PRIVATE = Path("/var/lib/private")
"""Of services with a user of their own; only root gets in there."""

KEPT = ".kept.mcap"
WHOLE = ".mcap"
PART = ".mcap.part"

KEPT_FILES = 50
"""So many of those in which something happened stay, the newest."""

FILES = 100
"""A file may have this part of all bytes: what is kept is at most half."""

S_PER_DAY = 86400

STAMP = "%Y%m%dT%H%M%SZ"
"""UTC, in the name of a file: when it began."""


def listed(directory: Path) -> list[Path]:
    """The recordings in it, oldest first."""
    found = [
        path
        for path in directory.iterdir()
        # A link or a pipe of such a name is none of ours, and may not even end.
        if _number(path) is not None and path.is_file() and not path.is_symlink()
    ]
    return sorted(found, key=lambda path: (_number(path), path.name))


def _number(path: Path) -> int | None:
    head, _, rest = path.name.partition("-")
    return int(head) if head.isdecimal() and rest.endswith((WHOLE, PART)) else None


def _began_s(path: Path) -> float:
    """Seconds since 1970 by its name; one without a time in it never gets old."""
    stamp = path.name.partition("-")[2].partition(".")[0]
    try:
        return calendar.timegm(time.strptime(stamp, STAMP))
    except ValueError:
        return math.inf


class Ring:
    """Makes room, begins and ends files. Everything may raise `OSError`."""

    def __init__(self, settings: RecordConfig, crashed: bool = True) -> None:
        """Take the directory, and make whole what was cut: by a crash, or by a disk of late."""
        self._directory = Path(settings.directory)
        self._bytes, self._days = int(settings.megabytes * 1e6), settings.days
        self.file_bytes = self._bytes // FILES
        here = self._directory.resolve()
        self._open = os.environ.get(RECORD) == settings.directory and here.is_relative_to(PRIVATE)
        if not self._directory.is_dir():
            self._directory.mkdir(parents=True)
            self._directory.chmod(DIRECTORY_MODE)  # whatever the umask takes away
        # Nobody else may open this one: who can, can hold it.
        self._lock = os.open(self._directory / ".lock", os.O_RDWR | os.O_CREAT, MODE)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise OSError(error.errno, "another daemon records there") from None
        try:
            for path in listed(self._directory):
                if path.name.endswith(PART):
                    _recover(path, KEPT if crashed else WHOLE)
        except OSError:
            self.close()
            raise
        if self._open:
            self._let_in()

    def _let_in(self) -> None:
        """Also to what a version has left that recorded for itself alone."""
        for path in (self._directory, *listed(self._directory)):
            mode = OPEN_DIRECTORY_MODE if path == self._directory else OPEN_MODE
            with suppress(OSError):  # somebody else's: to record comes first
                if stat.S_IMODE(path.stat().st_mode) != mode:
                    path.chmod(mode)

    def close(self) -> None:
        """Give the directory back."""
        os.close(self._lock)

    def begin(self, about: About) -> Writing:
        """A new file, after the newest."""
        files = listed(self._directory)
        number = 1 + max([_number(path) or 0 for path in files], default=0)
        stamp = time.strftime(STAMP, time.gmtime(about.wall_ns // 1_000_000_000))
        path = self._directory / f"{number:06}-{stamp}{PART}"
        writing = Writing(path, about, OPEN_MODE if self._open else MODE)
        self._sync()
        return writing

    def end(self, writing: Writing, keep: bool) -> Path:
        """Finish a file; where it is now."""
        writing.finish()
        stem = writing.path.name.removesuffix(PART)
        path = writing.path.with_name(stem + (KEPT if keep else WHOLE))
        writing.path.rename(path)
        self._sync()
        return path

    def keep(self, path: Path) -> None:
        """Something happened close to what is in this finished file."""
        if path.exists() and not path.name.endswith(KEPT):
            path.rename(path.with_name(path.name.removesuffix(WHOLE) + KEPT))
            self._sync()

    def trim(self, wall_ns: int) -> None:
        """Remove what is too much or too old; what is being written stays."""
        ended = [path for path in listed(self._directory) if not path.name.endswith(PART)]
        kept = [path for path in ended if path.name.endswith(KEPT)]
        plain = [path for path in ended if not path.name.endswith(KEPT)]
        sizes = {path: path.stat().st_size for path in ended}
        oldest_s = wall_ns / 1e9 - self._days * S_PER_DAY
        gone = {path for path in plain if _began_s(path) < oldest_s}
        gone.update(kept[: max(0, len(kept) - KEPT_FILES)])
        room = self._bytes - self.file_bytes - sum(sizes[p] for p in ended if p not in gone)
        for path in plain + kept:
            if room >= 0:
                break
            if path not in gone:
                gone.add(path)
                room += sizes[path]
        for path in ended:
            if path in gone:
                path.unlink(missing_ok=True)

    def _sync(self) -> None:
        """The names are on the disk too."""
        handle = os.open(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _recover(path: Path, ending: str) -> None:
    """A finished file of what is whole of one that was cut; one without anything goes."""
    whole = path.with_name(path.name.removesuffix(PART) + ending)
    written = path.with_name(f".{path.name}.new")
    written.unlink(missing_ok=True)
    try:
        count = rewrite(Recording(path), written)
    except RecordingError:
        count = 0
    if count:
        written.rename(whole)
    written.unlink(missing_ok=True)
    path.unlink()
