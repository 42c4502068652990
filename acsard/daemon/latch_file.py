"""The file that stores the latches for the next start of the daemon.

The robot starts as it ended, or stopped if the file cannot be read or written. One thread writes
the file: it renames a new one over the old one, waits until the disk has both, and reports. So a
kill after the rename loses nothing. A power cut before the end of the sync leaves the old file, the
new one or half of it, which counts as unreadable. The control loop never waits for the disk.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import secrets
import stat
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.codes import CODES, reason
from acsard.core.config.settings import Config
from acsard.core.motion.latches import after_restart, latched
from acsard.core.values import NS_PER_S, AcsardError, Cause, Event, Instant, Latches
from acsard.host import clock
from acsard.host.atomic_file import replace as replace_file
from acsard.host.atomic_file import sync
from acsard.host.errors import MSGSPEC_ERRORS, InUseError
from acsard.host.mailbox import Mailbox
from acsard.host.threads import NoThreadError, Worker, in_thread
from acsard.host.wait_timer import WaitTimer

FORMAT = 3  # another version is unreadable

MAX_BYTES = 65_536  # a larger file is unreadable; 32 causes take about 10 kB

MAX_NUMBER = 1 << 52  # later causes get higher ones, and JavaScript knows those below 2^53

MAX_TEXT_LENGTH = 500  # characters of a name or a reason

# A write and a sync that take longer are a disk that hangs. The start waits as long for the read,
# and again for the first write.
HANG_TIMEOUT_S = 2.0

MIN_WRITE_PAUSE_S = 0.05  # each stop changes the file: a flood of stops would wear out an SD card

RETRY_PAUSE_S = 1.0  # between two attempts to write

CLOSE_TIMEOUT_S = 0.3  # at the end of the daemon

# The answer to a stop waits for the disk no longer than this, or the client would believe that the
# robot did not receive its stop.
MAX_ANSWER_DELAY_NS = NS_PER_S // 5

DISK_HANGS = f"the disk did not answer within {HANG_TIMEOUT_S:g} s"


class Disk:
    """What the latch file asks of the file system, and how long it waits. Tests give another."""

    hang_timeout_s = HANG_TIMEOUT_S
    retry_pause_s = RETRY_PAUSE_S

    def read(self, path: Path) -> bytes:
        # Without O_NONBLOCK, opening a named pipe at this path would block the start.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(handle, "rb") as file:
            about = os.fstat(handle)
            if not stat.S_ISREG(about.st_mode):
                raise OSError(errno.EINVAL, "it is not a regular file")
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise OSError(errno.EFBIG, f"the file has more than {MAX_BYTES} bytes")
        return data

    def write(self, path: Path, data: bytes) -> None:
        replace_file(path, data, synced=False)

    def sync(self, path: Path) -> None:
        sync(path)


class LatchFileError(AcsardError):
    """The content of a latch file is damaged, of another version or of another robot."""


class _Content(Struct, frozen=True):
    format: int
    robot: str
    last: int
    causes: tuple[Cause, ...]


def encode(robot: str, latches: Latches) -> bytes:
    """Return the content of a robot's latch file, as indented JSON."""
    causes = [
        replace(cause, text=_safe(cause.text), part=_safe(cause.part), by=_safe(cause.by))
        for cause in latches.causes
    ]
    content = _Content(FORMAT, robot, latches.last, tuple(causes))
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def decode(robot: str, data: bytes) -> Latches:
    """Return the latches of a robot's file for the next run, whose numbers are all new.

    A later version may have written it: fields that it added are ignored, and a cause with a code
    that it added still holds the robot. Raises `LatchFileError` for other robots, for a format or a
    kind of cause that this version does not know, and for damage.
    """
    if not data.strip(b"\0 \r\n"):
        raise LatchFileError("it is empty")
    try:
        raw = msgspec.json.decode(data)
        number = raw.get("format") if isinstance(raw, dict) else None
        if type(number) is int and number != FORMAT:
            raise LatchFileError(
                f"another version of acsard wrote the file (format {number}, but this daemon reads "
                f"format {FORMAT})"
            )
        content = msgspec.convert(_with_known_codes(raw), _Content)
    except MSGSPEC_ERRORS as error:
        raise LatchFileError(f"it is damaged ({error})") from None
    if content.robot != robot:
        raise LatchFileError(f"it belongs to the robot {_safe(content.robot)!r:.60}")
    last, causes = content.last, content.causes
    if not (
        0 <= last <= MAX_NUMBER
        and all(0 < cause.number <= last and abs(cause.at_ns) < 1 << 63 for cause in causes)
    ):
        # No call could name such a number, and messages have no integers above 64 bits.
        raise LatchFileError("it is damaged (a number or a time is out of range)")
    # A run that was killed may have published numbers that are not in the file.
    return after_restart(Latches(causes, last + 1 + secrets.randbits(32)))


def new_latches() -> Latches:
    """Return no latches, with a random number, because the numbers before are unknown."""
    return Latches(last=secrets.randbits(48))


def unreadable(where: str, problem: str, now: Instant) -> Latches:
    """Return the latches for the start of a robot whose latch file cannot be read: stopped."""
    cause = f"the latch file ({where}) cannot be read: {problem}; a stop may have been lost"
    return _stopped(new_latches(), "read", cause, now)


def not_writable(latches: Latches, where: str, problem: str, now: Instant) -> Latches:
    """Return the latches for the start of a robot whose latch file cannot be written: stopped.

    The previous run may have lost a stop for the same reason.
    """
    return _stopped(latches, "write", unwritable(where, problem), now)


def unwritable(where: str, problem: str) -> str:
    """Return the message for a file that cannot be written."""
    return (
        f"a stop would not survive a restart: the latch file ({where}) cannot be written: {problem}"
    )


def place(config: Config, environ: Mapping[str, str]) -> Path:
    """Return the path of this robot's latch file, by its environment. Raises `OSError`."""
    name = f"{config.robot.id}.latches.json"
    try:
        if config.control.state_directory:
            return Path(config.control.state_directory).expanduser() / name
    except RuntimeError as error:
        raise OSError(errno.ENOENT, f"control.state_directory: {error}") from None
    # systemd may name several directories, with colons between them.
    service = environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service) / name
    # The XDG specification says that a relative path must be ignored.
    if environ.get("XDG_STATE_HOME", "").startswith("/"):
        return Path(environ["XDG_STATE_HOME"]) / "acsard" / name
    try:
        return Path.home() / ".local" / "state" / "acsard" / name
    except RuntimeError:
        raise OSError(
            errno.ENOENT,
            "this user has no home directory; set control.state_directory or $XDG_STATE_HOME",
        ) from None


class Keeper:
    """Gets the latches in force. This one stores nothing, as with the built-in simulator."""

    def __init__(self, latches: Latches) -> None:
        self.latches = latches

    @property
    def is_stored(self) -> bool:
        """Whether a power cut would lose none of the latches, or this keeper stores nothing."""
        return True

    @property
    def trouble(self) -> str | None:
        """Why the latches would not survive a restart, or ""; None without a file."""
        return None

    def keep(self, latches: Latches) -> None:
        """Take the latches in force; a later call may come before they are stored."""
        self.latches = latches

    def wait(self) -> None:
        """Block until the latches are stored or cannot be, at most `MAX_ANSWER_DELAY_NS`."""

    def take_events(self) -> list[Event]:
        """Return the events since the last call, such as a failed write."""
        return []


class LatchFile(Keeper):
    """The file that stores a robot's latches over a restart: `start()` once, then `keep()`."""

    def __init__(
        self, config: Config, environ: Mapping[str, str], disk: Disk | None = None
    ) -> None:
        super().__init__(Latches())
        self._disk = disk or Disk()
        self.where = "no directory"  # for messages
        self._robot, self._path, self._no_place = config.robot.id, Path(), ""
        try:
            self._path = place(config, environ)
            self.where = str(self._path)
        except OSError as error:
            self._no_place = _reason(error)
        self._lock = -1  # descriptor that keeps other daemons away, or -1
        self._box = Mailbox[Latches](1)  # to the thread
        self._renamed: Latches | None = None  # in the file
        self._stored: Latches | None = None  # on the disk
        self._failed = self._told = ""  # why the last write failed; the trouble of the last event
        self._timer, self._hangs = WaitTimer(), False
        self._thread = Worker("latches", self._work)

    async def start(self, now: Instant) -> None:
        """Read the file and write it: `latches` are then those with which the robot starts.

        They have a stop at `now` if that fails. Raises `InUseError` if another daemon uses the
        file.
        """
        try:
            self.latches = await in_thread(lambda: self._read(now), self._disk.hang_timeout_s)
        except TimeoutError as error:
            why = str(error) if isinstance(error, NoThreadError) else DISK_HANGS
            self.latches = unreadable(self.where, why, now)
        self.keep(self.latches)
        try:
            self._thread.start()
        except NoThreadError as error:
            self._failed = str(error)
        end_ns = clock.mono_ns() + self._disk.hang_timeout_s * NS_PER_S
        while self._renamed is None and not self._failed:
            if clock.mono_ns() > end_ns:
                self._failed = DISK_HANGS
            await asyncio.sleep(0.001)
        if self._failed:
            self.keep(not_writable(self.latches, self.where, self._failed, now))

    def _read(self, now: Instant) -> Latches:
        # Locks the file; a stop if it is unreadable. Raises `InUseError`.
        path = self._path
        if self._no_place:
            return new_latches()
        # A write replaces the file. If the path is a link, the write must replace its target,
        # because the link may be in a directory that loses its changes at a reboot. The target must
        # be a regular file: a write must not replace /dev/null. If the link cannot be followed, the
        # code below reports the error.
        with suppress(OSError):
            if path.is_symlink() and path.is_file():
                path = self._path = Path(os.path.realpath(path, strict=True))
                self.where = str(path)
        self._take_lock(path)
        try:
            # Only an absent file means that there is no stop. A symbolic link whose target is
            # absent counts as unreadable, because the disk of the target may not be mounted.
            os.lstat(path)
        except FileNotFoundError:
            return new_latches()
        except OSError as error:
            return unreadable(self.where, _reason(error), now)
        try:
            return decode(self._robot, self._disk.read(path))
        except (OSError, LatchFileError) as error:
            return unreadable(self.where, _reason(error), now)

    def _take_lock(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError:
            # The write of the file will fail too, and then the failure is reported.
            return
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise InUseError(
                f"another daemon stores the stop of robot {self._robot} in {path}; end that "
                "daemon, or give this robot its own id (robot.id) or its own directory "
                "(control.state_directory)"
            ) from None
        except OSError:
            os.close(lock)
            # This file system has no locks. The bus detects two daemons with the same id.
            return
        self._lock = lock
        # Remove the temporary files of processes that were killed while they wrote.
        with suppress(OSError):
            for temporary in path.parent.glob(f".{path.name}.*"):
                with suppress(OSError):
                    temporary.unlink()

    # The control loop calls the methods below.

    def keep(self, latches: Latches) -> None:
        self.latches = latches
        self._box.put(latches)

    @property
    def is_stored(self) -> bool:
        return self._stored is self.latches

    def wait(self) -> None:
        end_ns = clock.mono_ns() + MAX_ANSWER_DELAY_NS
        while not (self.is_stored or self._failed) and clock.mono_ns() < end_ns:
            time.sleep(0.001)

    def take_events(self) -> list[Event]:
        timeout_ns = self._disk.hang_timeout_s * NS_PER_S
        self._hangs = self._timer.wait_ns(clock.mono_ns()) > timeout_ns
        trouble = self.trouble
        if trouble == self._told:
            return []
        self._told = trouble
        if not trouble:
            text = f"the daemon can write {self.where} again, so stops survive a restart"
            return [Event("latch_file", text)]
        again = f"; the daemon tries again every {RETRY_PAUSE_S:g} s"
        text = trouble + (again if self._thread.is_alive() else "")
        return [Event("latch_file", text, "warning")]

    @property
    def trouble(self) -> str:
        failed = self._failed or (DISK_HANGS if self._hangs else "")
        if not self._thread.is_alive():
            failed = failed or "its thread has ended: restart the daemon"
        return unwritable(self.where, failed) if failed else ""

    def close(self) -> None:
        """Wait at most `CLOSE_TIMEOUT_S` until the latches are stored, and end the thread."""
        self._box.close()
        if self._thread.is_alive():
            self._thread.join(CLOSE_TIMEOUT_S)

    # The thread runs the methods below.

    def _work(self) -> None:
        latches: Latches | None = None
        while True:
            # Read `closed` before the latches, so that the last latches are not missed.
            over = self._box.closed
            latches = self._box.pop() or latches
            if latches is not None and self._write(latches):
                latches = None
                if not over:
                    time.sleep(MIN_WRITE_PAUSE_S)
            if over:
                return
            self._box.wait(None if latches is None else self._disk.retry_pause_s)

    def _write(self, latches: Latches) -> bool:
        self._timer.begin()
        try:
            if self._no_place:
                raise OSError(errno.ENOENT, self._no_place)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._disk.write(self._path, encode(self._robot, latches))
            self._renamed = latches
            self._disk.sync(self._path)
            self._disk.sync(self._path.parent)
        except OSError as error:
            # The kernel may have dropped the bytes that it could not sync, so all is done again.
            self._failed = _reason(error)
            return False
        finally:
            self._timer.end()
        self._stored, self._failed = latches, ""
        return True


def _stopped(latches: Latches, failed: str, cause: str, now: Instant) -> Latches:
    # The read and the write can fail for different reasons, which are then two causes.
    return latched(latches, "stop", reason("stopped_at_start", failed, cause=cause), now.wall_ns)


def _with_known_codes(raw: Any) -> Any:
    # The decoded JSON of a file, in which `Cause` can represent the code of each cause.
    match raw:
        case {"causes": list() as causes}:
            return raw | {"causes": [_with_known_code(cause) for cause in causes]}
    return raw


def _with_known_code(raw: Any) -> Any:
    match raw:
        case {"code": str(code), "text": str(text)} if code not in CODES:
            why = reason("other_version", _safe(code), cause=text, named=code)
            return raw | {"code": why.code, "text": why.text, "part": why.part}
    return raw


def _safe(text: str) -> str:
    return text[:MAX_TEXT_LENGTH].encode(errors="replace").decode()


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
