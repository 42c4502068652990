"""A directory of recordings, bounded in bytes, days and by the room there is on the disk.

    000012-20261121T070027Z.mcap.part   being written, or cut by a crash
    000012-20261121T070027Z.mcap        finished
    000012-20261121T070027Z.near.mcap   finished, less than a minute from what happened
    000012-20261121T070027Z.kept.mcap   finished, and something happened in it

The number gives the order, whatever the clocks said. `room` says which of them go.
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

from acsard.config.settings import RECORD, RecordConfig
from acsard.record.closing import CUTS
from acsard.record.file import MODE, About, Writing
from acsard.record.recovery import recover
from acsard.record.room import AROUND_NS, Bounds, Disk, Ended, Kind, Steady, share, too_much
from acsard.values import NS_PER_S, Instant

DIRECTORY_MODE = 0o750

OPEN_DIRECTORY_MODE, OPEN_MODE = 0o755, 0o644
"""Where the service records. Root alone gets to the directory around it, and the page, whose unit
has it mounted read-only. No group would do: a dynamic one has no name, and later systemds (257)
keep a state directory as nobody's on the disk."""

PRIVATE = Path("/var/lib/private")
"""Of services with a user of their own; only root gets in there."""

KEPT = ".kept.mcap"
NEAR = ".near.mcap"
WHOLE = ".mcap"
PART = ".mcap.part"

LEFT = ".left"
"""The ending of the mark of a file that no crash has cut."""

ENDINGS: dict[Kind, str] = {"plain": WHOLE, "near": NEAR, "kept": KEPT}

TRIM_ROUNDS = 600
"""Between two looks for what is too old: a file may grow for an hour."""

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


def _kind(path: Path) -> Kind:
    return "kept" if path.name.endswith(KEPT) else "near" if path.name.endswith(NEAR) else "plain"


def _stem(path: Path) -> str:
    return path.name.partition(".")[0]


def _stem_of(mark: Path) -> str:
    """Of the file that it is a mark of."""
    return mark.name[1:].partition(PART)[0]


def leave(part: Path, kind: Kind, cut: Literal["late", "disk"]) -> None:
    """The disk is too slow for the end of this file, or takes no more: no crash has cut it.

    A mark beside it says so, and what the file is: by its name, which a full disk takes, and whole
    or not at all. Raises `OSError`.
    """
    part.with_name(f".{part.name}.{kind}.{cut}{LEFT}").touch()


def _left(part: Path) -> tuple[Kind, str] | None:
    """What the file is that no crash has cut, and what has; None where a crash may have."""
    for mark in part.parent.glob(f".{part.name}.*{LEFT}"):
        first, _, cut = mark.name.removeprefix(f".{part.name}.").removesuffix(LEFT).partition(".")
        for kind in ENDINGS:
            if kind == first and cut in CUTS:
                return kind, cut
    return None


class Run(Struct):
    """What a daemon knows of its recordings from its start on, whatever becomes of the disk."""

    numbers: set[int] = field(default_factory=set)
    """Of the files that ended in it."""
    cut: dict[str, Kind] = field(default_factory=dict)
    """The files that the disk has cut in it, by name. What else is cut, a crash has cut before."""
    given: int = 0
    """bytes of recordings that went for a disk that refused, and has taken nothing since."""
    clock: Steady = field(default_factory=Steady)


class Ring:
    """Makes room, begins and ends files. Everything may raise `OSError`."""

    def __init__(
        self, settings: RecordConfig, run: Run | None = None, refused: bool = False
    ) -> None:
        """Take the directory, and make whole what was cut; `refused` says that the disk was
        full."""
        self._directory = Path(settings.directory)
        self._bytes, self._days = int(settings.megabytes * 1e6), settings.days
        self._run = run or Run()
        self._rounds = self.file_bytes = 0
        self.said: list[str] = []
        """What did not become whole, and why."""
        self.cut_ns: int | None = None
        """When a crash has cut the newest, ns since 1970."""
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
            for left in self._directory.glob(f".*{PART}.new"):
                left.unlink()  # a copy that did not become whole
            self.trim(None, refused)  # first: what is made whole needs room
            self._recover()
            for mark in self._directory.glob(f".*{PART}.*{LEFT}"):
                if not mark.with_name(f"{_stem_of(mark)}{PART}").exists():
                    mark.unlink()  # what it was of is whole now
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
                continue  # somebody removes it just now
            ours = self._run.cut.get(part.name)
            kind, cut = (ours, "disk") if ours else left or ("kept", "crash")
            whole = part.with_name(_stem(part) + ENDINGS[kind])
            try:
                said = recover(part, whole, cut, disk.free - seen.st_size > disk.spare)
            except OSError as error:  # to record what comes is more than that
                said = f"{part.name} cannot be made whole: {error.strerror}"
            self.said += [said] if said else []
            if ours:
                self._run.numbers.add(_number(part) or 0)
            elif whole.exists() and not left:
                self.cut_ns = seen.st_mtime_ns
                self._near(part, seen.st_mtime_ns)

    def _near(self, part: Path, cut_ns: int) -> None:
        """What ended less than a minute before it stays, too."""
        for path in listed(self._directory):
            with suppress(FileNotFoundError):  # somebody removes it just now
                before_ns = cut_ns - path.stat().st_mtime_ns
                earlier = (_number(path) or 0) < (_number(part) or 0)
                if earlier and before_ns < AROUND_NS:
                    self.keep(path)

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

    def end(self, writing: Writing, kind: Kind, cut: str = "", why: str = "") -> Path:
        """Finish a file, as `Writing.finish`; where it is now."""
        writing.finish(cut, why)
        path = writing.path.with_name(_stem(writing.path) + ENDINGS[kind])
        writing.path.rename(path)
        self._run.numbers.add(_number(path) or 0)
        self._sync()
        return path

    def just_ended(self, now: Instant) -> Iterator[tuple[Path, Kind, int]]:
        """What ended less than a minute ago by the wall clock, and when by the other one, ns."""
        for one in self._ended():
            ago_ns = now.wall_ns - int(one.at_s * NS_PER_S)
            if 0 <= ago_ns < AROUND_NS:
                yield self._directory / one.name, one.kind, now.mono_ns - ago_ns

    def keep(self, path: Path) -> None:
        """Something happened close to what is in this finished file."""
        if path.name.endswith(WHOLE) and _kind(path) == "plain":
            with suppress(FileNotFoundError):  # somebody has removed it
                path.rename(path.with_name(_stem(path) + NEAR))
            self._sync()

    def tend(self, now: Instant) -> None:
        """Once a second: where others want the room, or days have gone by, the oldest go."""
        jumped_ns = self._run.clock.look(now)
        if jumped_ns:
            self._set(jumped_ns)
        self._rounds += 1
        if self._rounds % TRIM_ROUNDS == 0 or self._disk().low:
            self.trim(now)

    def _set(self, jumped_ns: int) -> None:
        """The clock was set: what ended in this run is no older for that."""
        for path in listed(self._directory):
            if _number(path) in self._run.numbers:
                with suppress(FileNotFoundError):  # somebody removes it just now
                    seen = path.stat()
                    at_ns = max(0, seen.st_mtime_ns + jumped_ns)
                    os.utime(path, ns=(seen.st_atime_ns, at_ns))

    def trim(self, now: Instant | None, refused: bool = False) -> None:
        """Remove what is too much or too old; what is being written stays.

        `now` is None where no clock was looked at.
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
            with suppress(OSError):  # somebody else's: to record comes first
                (self._directory / name).unlink()
        own = sum(one.size for one in ended)
        self.file_bytes = share(self._bytes, own, disk)

    def _ended(self) -> list[Ended]:
        found = []
        for path in listed(self._directory):
            if path.name.endswith(PART):
                continue
            with suppress(FileNotFoundError):  # somebody removes it just now
                seen, number = path.stat(), _number(path) or 0
                here = number in self._run.numbers
                size, at_s = seen.st_size, seen.st_mtime
                found.append(Ended(path.name, number, _kind(path), size, at_s, here))
        return found

    def _disk(self) -> Disk:
        told = os.statvfs(self._directory)
        if not told.f_blocks:  # it does not say
            return Disk(0, self._bytes)
        return Disk(told.f_blocks * told.f_frsize, told.f_bavail * told.f_frsize)

    def _sync(self) -> None:
        """The names are on the disk too."""
        handle = os.open(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
