"""Manages the directory of recordings: begins, finishes and deletes files.

    000012-20261121T070027Z.mcap.part   being written, or cut off
    000012-20261121T070027Z.mcap        finished
    000012-20261121T070027Z.near.mcap   finished, within a minute of an incident
    000012-20261121T070027Z.kept.mcap   finished, with an incident (or a crash) in it

The number gives the order, even if the wall clock was adjusted. `retention.py` decides deletions.
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

from acsard.core.config.settings import RECORD_VARIABLE, RecordConfig
from acsard.core.formatting import listed as listed_names
from acsard.core.formatting import many
from acsard.core.values import NS_PER_S, Event, Instant, Ns, WallNs
from acsard.host.atomic_file import real_path, sync
from acsard.recording.end_record import CUT_TEXTS
from acsard.recording.mcap_file import FILE_MODE, About, RecordingWriter
from acsard.recording.recovery import recover
from acsard.recording.retention import (
    INCIDENT_MARGIN_NS,
    MIN_FILE_BYTES,
    Bounds,
    ClockWatch,
    Disk,
    FinishedFile,
    Kind,
    file_size_limit,
    to_delete,
)

DIRECTORY_MODE = 0o750

# Every user may read the files, but only root can enter `PRIVATE_STATE`. The page's service reads
# them through a read-only mount: its dynamic group has no name to give permissions to, and systemd
# 257 makes `nobody` the owner of state directories.
OPEN_DIRECTORY_MODE, OPEN_MODE = 0o755, 0o644

PRIVATE_STATE = Path("/var/lib/private")  # of services with a dynamic user; only root can enter it

KEPT_SUFFIX = ".kept.mcap"
NEAR_SUFFIX = ".near.mcap"
MCAP_SUFFIX = ".mcap"
PART_SUFFIX = ".mcap.part"

MARKER_SUFFIX = ".left"  # of a marker that the disk, and not a crash, cut off a `.part` file

# Ends of the names of finished files, by retention class.
SUFFIX_OF_KIND: dict[Kind, str] = {"kept": KEPT_SUFFIX, "near": NEAR_SUFFIX, "plain": MCAP_SUFFIX}

TRIM_ROUNDS = 600  # seconds, as calls of `maintain`, between two searches for too old files

S_PER_DAY = 86400

MAX_NAMES = 5  # of deleted files in an event

BEING_RECORDED_S = 10.0  # a daemon writes once a second

NAME_TIME_FORMAT = "%Y%m%dT%H%M%SZ"  # UTC, of the beginning


def listed(directory: Path) -> list[Path]:
    """Return the recordings in a directory, the oldest first, unfinished ones too."""
    paths = [
        path
        for path in directory.iterdir()
        # A pipe or a link with such a name is not a recording, and reading a pipe may never end.
        if _number(path) >= 0 and path.is_file() and not path.is_symlink()
    ]
    return sorted(paths, key=lambda path: (_number(path), path.name))


def is_being_recorded(path: Path, now_s: float) -> bool:
    """Return whether a daemon is still writing to a file, `now_s` after 1970. Raises `OSError`."""
    return path.name.endswith(PART_SUFFIX) and abs(now_s - path.stat().st_mtime) < BEING_RECORDED_S


def _number(path: Path) -> int:
    # -1: not a recording's name
    head, _, rest = path.name.partition("-")
    return int(head) if head.isdecimal() and rest.endswith((MCAP_SUFFIX, PART_SUFFIX)) else -1


def _kind(path: Path) -> Kind:
    return next(kind for kind, suffix in SUFFIX_OF_KIND.items() if path.name.endswith(suffix))


def stem(path: Path) -> str:
    """Return the part of a file's name that stays when its state changes."""
    return path.name.partition(".")[0]


def mark_cut(part: Path, kind: Kind, cut: Literal["late", "disk"]) -> None:
    """Create the marker of a `.part` file that the disk cut off ("late": too slow; "disk": full).

    Otherwise the next start would assume a crash. `kind` is its class when it is finished. Raises
    `OSError`.
    """
    # Even a full disk usually accepts a new name, so the marker is empty.
    part.with_name(f".{part.name}.{kind}.{cut}{MARKER_SUFFIX}").touch()


def _marked(part: Path) -> tuple[Kind, str] | None:
    for marker in part.parent.glob(f".{part.name}.*{MARKER_SUFFIX}"):
        words = marker.name.removeprefix(f".{part.name}.").removesuffix(MARKER_SUFFIX)
        first, _, cut = words.partition(".")
        for kind in SUFFIX_OF_KIND:
            if kind == first and cut in CUT_TEXTS:
                return kind, cut
    return None


def _deletion(names: list[str], disk: Disk, refused: bool) -> Event:
    if disk.low:
        reason = (
            f"only {disk.free / 1e6:.1f} MB of the disk were free, and recordings leave "
            f"{disk.spare / 1e6:.1f} MB to other programs; remove other files from the disk"
        )
    elif refused:
        reason = "the disk accepted no more data; remove other files from the disk"
    else:
        reason = f"they exceeded record.megabytes or {MAX_AGE_DAYS} days"
    text = f"{many(len(names), 'recording')} deleted ({listed_names(names, MAX_NAMES)}): {reason}"
    return Event("recording", text, "warning" if disk.low or refused else "info")


def disk_has_room(directory: Path) -> bool:
    """Return whether the disk reports enough free space for a small file."""
    size = os.statvfs(directory)
    # Some file systems do not report their size.
    return not size.f_blocks or size.f_bavail * size.f_frsize >= MIN_FILE_BYTES


class Run(Struct):
    """State of one run of the daemon, which outlives a `RecordingDirectory` after a disk error."""

    numbers: set[int] = field(default_factory=set)  # of files that ended in this run
    # Class of each file that a disk error cut off, by name. A crash before this run cut off others.
    cut: dict[str, Kind] = field(default_factory=dict)
    freed: int = 0  # bytes deleted for a full disk since the last successful write
    clock: ClockWatch = field(default_factory=ClockWatch)
    events: list[Event] = field(default_factory=list)  # about deleted files, for `StepWriter`


MAX_AGE_DAYS = 14  # of a recording without a stop, a fault, a lost link or a crash


class RecordingDirectory:
    """The directory of recordings, locked until `close`: begins and ends files, makes room.

    Every method may raise `OSError`.
    """

    def __init__(
        self, settings: RecordConfig, run: Run | None = None, refused: bool = False
    ) -> None:
        # Makes room, and finishes files that were cut off. `refused`: the disk refused the last
        # write although it reported free space.
        self._directory = Path(settings.directory)
        self._bytes = int(settings.megabytes * 1e6)
        self._run = run or Run()
        self._rounds = self.file_bytes = 0  # calls of `maintain`; size at which a file should end
        self.messages: list[str] = []  # for the log, about damaged or unfinished files
        self.cut_ns: WallNs | None = None  # crash that cut off an earlier run's newest file
        here = real_path(self._directory, new=True)
        as_service = os.environ.get(RECORD_VARIABLE) == settings.directory
        self._open_to_all = as_service and here.is_relative_to(PRIVATE_STATE)
        if not self._directory.is_dir():
            self._directory.mkdir(parents=True)
            # The umask may have removed bits of the mode.
            self._directory.chmod(DIRECTORY_MODE)
        # A process that can open the lock file can lock it.
        self._lock = os.open(self._directory / ".lock", os.O_RDWR | os.O_CREAT, FILE_MODE)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise OSError(
                error.errno,
                "another daemon records into this directory: choose another record.directory",
            ) from None
        try:
            for copy in self._directory.glob(f".*{PART_SUFFIX}.new"):
                # A crash interrupted the writing of this copy.
                copy.unlink()
            # Make room first, because finishing a file needs disk space.
            self.trim(None, refused)
            self._recover()
            for marker in self._directory.glob(f".*{PART_SUFFIX}.*{MARKER_SUFFIX}"):
                recording = marker.name[1:].partition(PART_SUFFIX)[0]
                if not marker.with_name(f"{recording}{PART_SUFFIX}").exists():
                    # The recording of this marker is finished.
                    marker.unlink()
            if self._open_to_all:
                self._open_files()
        except OSError:
            self.close()
            raise

    def _recover(self) -> None:
        for part in [path for path in listed(self._directory) if path.name.endswith(PART_SUFFIX)]:
            try:
                status, marked, disk = part.stat(), _marked(part), self._disk()
            except FileNotFoundError:
                continue  # another process has just removed it
            ours = self._run.cut.get(part.name)
            kind, cut = (ours, "disk") if ours else marked or ("kept", "crash")
            whole = part.with_name(stem(part) + SUFFIX_OF_KIND[kind])
            try:
                message = recover(part, whole, cut, disk.free - status.st_size > disk.spare)
            # Recording new steps is more important than finishing an old file.
            except OSError as error:
                message = f"{part.name} cannot be completed: {error.strerror}"
            self.messages += [message] if message else []
            if ours:
                self._run.numbers.add(_number(part))
            elif whole.exists() and not marked:
                self.cut_ns = status.st_mtime_ns
                self._retain_before(part, status.st_mtime_ns)

    def _retain_before(self, part: Path, cut_ns: WallNs) -> None:
        # `plain` files within a minute before the crash at `cut_ns` become `near`.
        for path in listed(self._directory):
            # Another process may have just removed the file.
            with suppress(FileNotFoundError):
                before_ns = cut_ns - path.stat().st_mtime_ns
                earlier = _number(path) < _number(part)
                # Without a battery-backed clock, older files seem to have ended long after the
                # crash.
                if earlier and abs(before_ns) < INCIDENT_MARGIN_NS:
                    self.retain(path)

    def _open_files(self) -> None:
        # Files of older versions, too.
        for path in (self._directory, *listed(self._directory)):
            mode = OPEN_DIRECTORY_MODE if path == self._directory else OPEN_MODE
            # The file may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                if stat.S_IMODE(path.stat().st_mode) != mode:
                    path.chmod(mode)

    def close(self) -> None:
        os.close(self._lock)

    def begin(self, about: About) -> RecordingWriter:
        """Create and return a new file, numbered after the largest number in the directory."""
        files = listed(self._directory)
        number = 1 + max([_number(path) for path in files], default=0)
        stamp = time.strftime(NAME_TIME_FORMAT, time.gmtime(about.wall_ns // 1_000_000_000))
        path = self._directory / f"{number:06}-{stamp}{PART_SUFFIX}"
        writing = RecordingWriter(path, about, OPEN_MODE if self._open_to_all else FILE_MODE)
        # Not only the content of the new file but also its name must reach the disk.
        sync(self._directory)
        return writing

    def end(self, writing: RecordingWriter, kind: Kind, cut: str = "", why: str = "") -> Path:
        """Finish a file, rename it by its class, and return its new path.

        `cut` is a key of `CUT_TEXTS`, "" for an ordinary end, and `why` its explanation.
        """
        writing.finish(cut, why)
        path = writing.path.with_name(stem(writing.path) + SUFFIX_OF_KIND[kind])
        writing.path.rename(path)
        self._run.numbers.add(_number(path))
        sync(self._directory)
        return path

    def just_ended(self, now: Instant) -> Iterator[tuple[Path, Kind, int]]:
        """Yield path, class and end of each file that ended within a minute before `now`."""
        for file in self._ended():
            ago_ns = now.wall_ns - int(file.at_s * NS_PER_S)
            if 0 <= ago_ns < INCIDENT_MARGIN_NS:
                yield self._directory / file.name, file.kind, now.mono_ns - ago_ns

    def retain(self, path: Path) -> None:
        """Rename a `plain` file to `near`: it ended less than a minute before an incident."""
        if path.name.endswith(MCAP_SUFFIX) and _kind(path) == "plain":
            # Another process may have removed the file.
            with suppress(FileNotFoundError):
                path.rename(path.with_name(stem(path) + NEAR_SUFFIX))
            sync(self._directory)

    def maintain(self, now: Instant) -> None:
        """Call `trim` every ten minutes and when the disk is nearly full; call this once a second.

        After a jump of the wall clock, also correct the modification times of this run's files.
        """
        jumped_ns = self._run.clock.jump_ns(now)
        if jumped_ns:
            self._shift_times(jumped_ns)
        self._rounds += 1
        if self._rounds % TRIM_ROUNDS == 0 or self._disk().low:
            self.trim(now)

    def _shift_times(self, jumped_ns: Ns) -> None:
        for path in listed(self._directory):
            if _number(path) in self._run.numbers:
                # Another process may have just removed the file.
                with suppress(FileNotFoundError):
                    status = path.stat()
                    at_ns = max(0, status.st_mtime_ns + jumped_ns)
                    os.utime(path, ns=(status.st_atime_ns, at_ns))

    def trim(self, now: Instant | None, refused: bool = False) -> None:
        """Delete finished recordings beyond the limits on size, age and free space.

        Updates `file_bytes`. Without `now`, no file is too old. `refused` is as in the constructor.
        """
        ended, disk = self._ended(), self._disk()
        oldest_s = -math.inf
        if now is not None and self._run.clock.trusted(now):
            oldest_s = now.wall_ns / NS_PER_S - MAX_AGE_DAYS * S_PER_DAY
        freed = self._run.freed if refused else None
        names = to_delete(ended, Bounds(self._bytes, oldest_s), disk, freed)
        deleted = list[str]()
        for file in ended:
            # The file may belong to another user. Recording goes on in any case.
            with suppress(OSError):
                if file.name in names:
                    (self._directory / file.name).unlink()
                    self._run.freed += file.size if refused else 0
                    deleted.append(file.name)
        if deleted:
            self._run.events.append(_deletion(deleted, disk, refused))
        self.file_bytes = file_size_limit(self._bytes, sum(file.size for file in ended), disk)

    def _ended(self) -> list[FinishedFile]:
        ended = []
        for path in listed(self._directory):
            if path.name.endswith(PART_SUFFIX):
                continue
            # Another process may have just removed the file.
            with suppress(FileNotFoundError):
                status, number = path.stat(), _number(path)
                this_run = number in self._run.numbers
                size, at_s = status.st_size, status.st_mtime
                ended.append(FinishedFile(path.name, number, _kind(path), size, at_s, this_run))
        return ended

    def _disk(self) -> Disk:
        size = os.statvfs(self._directory)
        # Some file systems do not report their size.
        if not size.f_blocks:
            return Disk(0, self._bytes)
        return Disk(size.f_blocks * size.f_frsize, size.f_bavail * size.f_frsize)
