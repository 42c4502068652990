"""The directory of recordings, bounded in bytes, in days and by the free space of the disk.

    000012-20261121T070027Z.mcap.part   being written, or cut off by a crash
    000012-20261121T070027Z.mcap        finished
    000012-20261121T070027Z.near.mcap   finished, less than a minute from an incident
    000012-20261121T070027Z.kept.mcap   finished, and an incident happened in it

The number gives the order of the files, even if the wall clock was set. `room` decides which files
are deleted.
"""

from __future__ import annotations

import fcntl
import math
import os
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

from msgspec import Struct, field

from acsard.core.config.settings import RECORD, RecordConfig
from acsard.core.values import NS_PER_S, Instant
from acsard.host.atomic_file import sync
from acsard.recording.end_record import CUTS
from acsard.recording.file import MODE, About, Writing
from acsard.recording.recovery import recover
from acsard.recording.retention import AROUND_NS, Bounds, Disk, Ended, Kind, Steady, share, too_much

DIRECTORY_MODE = 0o750

OPEN_DIRECTORY_MODE, OPEN_MODE = 0o755, 0o644
"""Modes of the directory and its files when the daemon records as a systemd service: open to all.

They are safe because only root can enter the directory above, and the unit of the robot's page
mounts this one read-only. A group cannot give this access: a dynamic group has no name, and later
versions of systemd (257) keep a state directory as nobody's on the disk.
"""

PRIVATE = Path("/var/lib/private")
"""Parent of the state directories of services with a dynamic user; only root can enter it."""

KEPT = ".kept.mcap"
NEAR = ".near.mcap"
WHOLE = ".mcap"
PART = ".mcap.part"

LEFT = ".left"
"""Suffix of the marker file that says that a `.part` file was not cut off by a crash."""

ENDINGS: dict[Kind, str] = {"plain": WHOLE, "near": NEAR, "kept": KEPT}

TRIM_ROUNDS = 600
"""Calls of `tend`, one per second, between two searches for files that are too old. A file may
grow for an hour, so ten minutes are often enough.
"""

S_PER_DAY = 86400

STAMP = "%Y%m%dT%H%M%SZ"
"""Format of the time at which a file began, in UTC, as its name holds it."""


def listed(directory: Path) -> list[Path]:
    """Return the recordings in a directory, oldest first."""
    found = [
        path
        for path in directory.iterdir()
        # A link or a pipe with such a name is not a recording, and reading a pipe may never end.
        if _number(path) is not None and path.is_file() and not path.is_symlink()
    ]
    return sorted(found, key=lambda path: (_number(path), path.name))


def _number(path: Path) -> int | None:
    head, _, rest = path.name.partition("-")
    return int(head) if head.isdecimal() and rest.endswith((WHOLE, PART)) else None


def _kind(path: Path) -> Kind:
    return "kept" if path.name.endswith(KEPT) else "near" if path.name.endswith(NEAR) else "plain"


def _stem(path: Path) -> str:
    return path.name.partition(".")[0]


def _stem_of(mark: Path) -> str:
    """Return the stem of the recording to which a marker file belongs."""
    return mark.name[1:].partition(PART)[0]


def leave(part: Path, kind: Kind, cut: Literal["late", "disk"]) -> None:
    """Mark a `.part` file whose end the disk did not take, so that it does not pass for a crash.

    The name of an empty marker file holds the retention class and the cause. A full disk still
    takes a name, and it is there completely or not at all. Raises `OSError`.
    """
    part.with_name(f".{part.name}.{kind}.{cut}{LEFT}").touch()


def _left(part: Path) -> tuple[Kind, str] | None:
    """Return the retention class and the cause from a file's marker.

    Returns None for a file without a marker: a crash may have cut it off.
    """
    for mark in part.parent.glob(f".{part.name}.*{LEFT}"):
        first, _, cut = mark.name.removeprefix(f".{part.name}.").removesuffix(LEFT).partition(".")
        for kind in ENDINGS:
            if kind == first and cut in CUTS:
                return kind, cut
    return None


class Run(Struct):
    """State that lasts as long as the daemon, even if `Ring` is opened again after a disk error."""

    numbers: set[int] = field(default_factory=set)
    """Numbers of the files that ended in this run of the daemon."""
    cut: dict[str, Kind] = field(default_factory=dict)
    """Retention classes, by name, of the files that a disk error cut off in this run. Any other
    cut file was cut off by a crash before this run.
    """
    given: int = 0
    """Bytes deleted since a disk refused to write, as long as it still refuses."""
    clock: Steady = field(default_factory=Steady)


class Ring:
    """Directory of recordings, in which files begin, end and are deleted.

    Every method may raise `OSError`.
    """

    def __init__(
        self, settings: RecordConfig, run: Run | None = None, refused: bool = False
    ) -> None:
        """Lock the directory, make room in it, and finish the files that were cut off.

        `refused` says that the last write failed because the disk was full.
        """
        self._directory = Path(settings.directory)
        self._bytes, self._days = int(settings.megabytes * 1e6), settings.days
        self._run = run or Run()
        self._rounds = self.file_bytes = 0
        self.said: list[str] = []
        """Messages about files that could not be finished."""
        self.cut_ns: int | None = None
        """Time at which a crash cut off the newest file, ns since 1970, or None."""
        here = self._directory.resolve()
        self._open = os.environ.get(RECORD) == settings.directory and here.is_relative_to(PRIVATE)
        if not self._directory.is_dir():
            self._directory.mkdir(parents=True)
            # The umask may have removed bits of the mode.
            self._directory.chmod(DIRECTORY_MODE)
        # No other user may open this file: a process that can open it can hold the lock.
        self._lock = os.open(self._directory / ".lock", os.O_RDWR | os.O_CREAT, MODE)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise OSError(error.errno, "another daemon records there") from None
        try:
            for left in self._directory.glob(f".*{PART}.new"):
                # This copy was not completed.
                left.unlink()
            # Make room first, because finishing a file needs some.
            self.trim(None, refused)
            self._recover()
            for mark in self._directory.glob(f".*{PART}.*{LEFT}"):
                if not mark.with_name(f"{_stem_of(mark)}{PART}").exists():
                    # The file of this marker is finished.
                    mark.unlink()
        except OSError:
            self.close()
            raise
        if self._open:
            self._let_in()

    def _recover(self) -> None:
        for part in [path for path in listed(self._directory) if path.name.endswith(PART)]:
            try:
                seen, left, disk = part.stat(), _left(part), self._disk()
            except FileNotFoundError:
                # Another process has just removed the file.
                continue
            ours = self._run.cut.get(part.name)
            kind, cut = (ours, "disk") if ours else left or ("kept", "crash")
            whole = part.with_name(_stem(part) + ENDINGS[kind])
            try:
                said = recover(part, whole, cut, disk.free - seen.st_size > disk.spare)
            # Recording new steps is more important than finishing an old file.
            except OSError as error:
                said = f"{part.name} cannot be completed: {error.strerror}"
            self.said += [said] if said else []
            if ours:
                self._run.numbers.add(_number(part) or 0)
            elif whole.exists() and not left:
                self.cut_ns = seen.st_mtime_ns
                self._near(part, seen.st_mtime_ns)

    def _near(self, part: Path, cut_ns: int) -> None:
        """Retain the files that ended less than a minute before the crash that cut off `part`."""
        for path in listed(self._directory):
            # Another process may have just removed the file.
            with suppress(FileNotFoundError):
                before_ns = cut_ns - path.stat().st_mtime_ns
                earlier = (_number(path) or 0) < (_number(part) or 0)
                if earlier and before_ns < AROUND_NS:
                    self.keep(path)

    def _let_in(self) -> None:
        """Give the service's modes to the directory and to all files in it.

        An earlier version of acsard may have left files that only its own user can read.
        """
        for path in (self._directory, *listed(self._directory)):
            mode = OPEN_DIRECTORY_MODE if path == self._directory else OPEN_MODE
            # The file may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                if stat.S_IMODE(path.stat().st_mode) != mode:
                    path.chmod(mode)

    def close(self) -> None:
        """Release the lock of the directory."""
        os.close(self._lock)

    def begin(self, about: About) -> Writing:
        """Begin a new file, with a number above every other."""
        files = listed(self._directory)
        number = 1 + max([_number(path) or 0 for path in files], default=0)
        stamp = time.strftime(STAMP, time.gmtime(about.wall_ns // 1_000_000_000))
        path = self._directory / f"{number:06}-{stamp}{PART}"
        writing = Writing(path, about, OPEN_MODE if self._open else MODE)
        # The names of the files must be on the disk as well as their content.
        sync(self._directory)
        return writing

    def end(self, writing: Writing, kind: Kind, cut: str = "", why: str = "") -> Path:
        """Finish a file as `Writing.finish` does.

        Returns its new path, named by its retention class.
        """
        writing.finish(cut, why)
        path = writing.path.with_name(_stem(writing.path) + ENDINGS[kind])
        writing.path.rename(path)
        self._run.numbers.add(_number(path) or 0)
        sync(self._directory)
        return path

    def just_ended(self, now: Instant) -> Iterator[tuple[Path, Kind, int]]:
        """Yield the files that ended less than a minute ago by the wall clock.

        Each comes with its retention class and its end in ns of the monotonic clock.
        """
        for one in self._ended():
            ago_ns = now.wall_ns - int(one.at_s * NS_PER_S)
            if 0 <= ago_ns < AROUND_NS:
                yield self._directory / one.name, one.kind, now.mono_ns - ago_ns

    def keep(self, path: Path) -> None:
        """Retain a finished plain file, because an incident happened within a minute of it."""
        if path.name.endswith(WHOLE) and _kind(path) == "plain":
            # Another process may have removed the file.
            with suppress(FileNotFoundError):
                path.rename(path.with_name(_stem(path) + NEAR))
            sync(self._directory)

    def tend(self, now: Instant) -> None:
        """Delete the oldest files when the disk is low, and in every `TRIM_ROUNDS`-th call.

        Call it once a second.
        """
        jumped_ns = self._run.clock.look(now)
        if jumped_ns:
            self._set(jumped_ns)
        self._rounds += 1
        if self._rounds % TRIM_ROUNDS == 0 or self._disk().low:
            self.trim(now)

    def _set(self, jumped_ns: int) -> None:
        """Shift the file times of this run by the step of the wall clock, so that the files do
        not look older or newer than they are.
        """
        for path in listed(self._directory):
            if _number(path) in self._run.numbers:
                # Another process may have just removed the file.
                with suppress(FileNotFoundError):
                    seen = path.stat()
                    at_ns = max(0, seen.st_mtime_ns + jumped_ns)
                    os.utime(path, ns=(seen.st_atime_ns, at_ns))

    def trim(self, now: Instant | None, refused: bool = False) -> None:
        """Delete the files that exceed the bounds in bytes or in age.

        The file that is being written stays. `now` is None before a clock has been read; then no
        file counts as too old.
        """
        ended, disk = self._ended(), self._disk()
        believed = now is not None and self._run.clock.believed(now)
        oldest_s = (
            now.wall_ns / NS_PER_S - self._days * S_PER_DAY if now and believed else -math.inf
        )
        given = self._run.given if refused else None
        gone = too_much(ended, Bounds(self._bytes, oldest_s), disk, given)
        if refused:
            self._run.given += sum(one.size for one in ended if one.name in gone)
        for name in gone:
            # The file may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                (self._directory / name).unlink()
        own = sum(one.size for one in ended)
        self.file_bytes = share(self._bytes, own, disk)

    def _ended(self) -> list[Ended]:
        found = []
        for path in listed(self._directory):
            if path.name.endswith(PART):
                continue
            # Another process may have just removed the file.
            with suppress(FileNotFoundError):
                seen, number = path.stat(), _number(path) or 0
                here = number in self._run.numbers
                size, at_s = seen.st_size, seen.st_mtime
                found.append(Ended(path.name, number, _kind(path), size, at_s, here))
        return found

    def _disk(self) -> Disk:
        told = os.statvfs(self._directory)
        # The file system does not report its size.
        if not told.f_blocks:
            return Disk(0, self._bytes)
        return Disk(told.f_blocks * told.f_frsize, told.f_bavail * told.f_frsize)
