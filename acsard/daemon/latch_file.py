"""The file that stores the latches for the next start of the daemon (`latch_rules.py`).

The control loop hands them to a thread that writes the file, and never waits for the disk. After
the rename, a kill loses nothing, and after the sync of a second thread, a power cut. There are two,
because a stop must not wait for the sync of earlier latches, which takes up to seconds on an SD
card.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from msgspec.structs import replace as replace_fields

from acsard.core.config.settings import Config
from acsard.core.values import NS_PER_S, Event, Instant, Latches
from acsard.daemon.latch_rules import (
    MAX_BYTES,
    LatchFileError,
    LatchKeeper,
    after_failed_write,
    at_start,
    decode,
    encode,
    stopped,
    unreadable,
    unwritable,
)
from acsard.host import clock
from acsard.host.atomic_file import replace, sync
from acsard.host.errors import InUseError
from acsard.host.mailbox import Mailbox
from acsard.host.threads import NoThreadError, Worker, in_thread
from acsard.host.wait_timer import WaitTimer

# A write or a sync that takes longer is a disk that hangs. At the start, the first read and write
# together may take this time.
HANG_TIMEOUT_S = 2.0

MIN_WRITE_PAUSE_S = 0.05  # each stop is a new latch: a flood of stops would wear out an SD card

RETRY_PAUSE_S = 1.0  # between two attempts to write

CLOSE_TIMEOUT_S = 0.3  # at the end of the daemon

DISK_HANGS = f"the disk did not answer within {HANG_TIMEOUT_S:g} s"

MAX_EVENTS = 64  # for the next control step; the oldest goes


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


class LatchFile(LatchKeeper):
    """The file that stores a robot's latches over a restart: `start()` once, then `keep()`."""

    def __init__(self, config: Config, environ: Mapping[str, str]) -> None:
        self.where = "no directory"  # for messages
        self._path: Path | None = None  # of the target, if it is a link
        self._robot = config.robot.id
        self._barred = ""  # why the file must never be written
        try:
            self._path = place(config, environ)
            self.where = str(self._path)
        except OSError as error:
            self._barred = _reason(error)
        self._lock = -1  # descriptor that keeps other daemons away, or -1
        # Held while reading or writing, not for a sync, and never by the control loop.
        self._disk = threading.Lock()
        self._abandoned = False  # `start` timed out while another thread used the file
        self._start_latches: Latches | None = None  # in the file at the start
        self._blind = False  # not read in time: the writing thread reads it before its first write
        self._missed = Latches()  # latches in such a file, which each write adds again
        self._box = Mailbox[Latches](1)  # to the writing thread
        self._news = Mailbox[Event](MAX_EVENTS)
        self._written_latches: Latches | None = None  # by this process
        self._failed = ""
        self._newest_latches: Latches | None = None  # of the last `keep`
        self._write_timer, self._sync_timer = WaitTimer(), WaitTimer()
        self._hangs = False  # at the last `take_events`
        self._renamed = Mailbox[Latches](1)  # in the file, to the syncing thread
        self._threads: tuple[Worker, ...] = ()  # for writing and syncing, once both run

    # The start of the daemon calls the methods below.

    async def start(self, now: Instant) -> Latches:
        """Read the file, try to write it, and return the latches with which the robot starts.

        They have a stop at `now` if that fails. Raises `InUseError` if another daemon uses the
        file.
        """
        try:
            latches = await in_thread(lambda: self._load(now), HANG_TIMEOUT_S)
        except TimeoutError as error:
            self._abandoned = True
            why = str(error) if isinstance(error, NoThreadError) else DISK_HANGS
            self._fail(why)
            file_latches = self._start_latches
            if file_latches is None:
                self._blind = True
                latches = self._if_unreadable(why, now)
            else:
                latches = self._if_unwritable(file_latches, why, now)
            self.keep(latches)
        threads = (
            Worker("latches", lambda: self._work(now)),
            Worker("latches to disk", self._sync_each),
        )
        try:
            for thread in threads:
                thread.start()
        except NoThreadError as error:
            # The first thread may run already. Without the second thread, the first one must not
            # write, and must not report a recovery. `_barred` prevents both.
            self._barred = str(error)
            self._fail(self._barred)
            return self._if_unwritable(latches, self._failed, now)
        self._threads = threads
        return latches

    def _load(self, now: Instant) -> Latches:
        with self._disk:
            if self._abandoned:
                return Latches()
            latches = self._start_latches = self._read(now)
            trouble = self._replace(latches)
            if trouble and not self._abandoned:
                self._fail(trouble)
                latches = self._if_unwritable(latches, trouble, now)
                self.keep(latches)
            return latches

    def _if_unreadable(self, why: str, now: Instant) -> Latches:
        return stopped(Latches(), unreadable(self.where, why), now)

    def _if_unwritable(self, latches: Latches, why: str, now: Instant) -> Latches:
        return after_failed_write(latches, at_start(unwritable(self.where, why)), now)

    def _read(self, now: Instant) -> Latches:
        # Locks the file; a stop if it is unreadable. Raises `InUseError`.
        path = self._path
        if path is None:
            return Latches()
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
            return Latches()
        except OSError as error:
            return self._if_unreadable(_reason(error), now)
        try:
            return decode(self._robot, _content(path))
        except (OSError, LatchFileError) as error:
            return self._if_unreadable(_reason(error), now)

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
            self._barred = (
                f"another daemon stores the stop of robot {self._robot} in {path}; end that "
                "daemon, or give this robot its own id (robot.id) or its own directory "
                "(control.state_directory)"
            )
            raise InUseError(self._barred) from None
        except OSError:
            os.close(lock)
            # This file system has no locks. The bus detects two daemons with the same id.
            return
        self._lock = lock
        # Remove the temporary files of processes that were killed while they wrote.
        with suppress(OSError):
            for left in path.parent.glob(f".{path.name}.*"):
                with suppress(OSError):
                    left.unlink()

    # The control loop calls the methods below, which `LatchKeeper` describes.

    def keep(self, latches: Latches) -> None:
        self._newest_latches = latches
        self._box.put(latches)

    def holds(self, latches: Latches) -> bool:
        return self._written_latches is latches

    def wait(self, latches: Latches, seconds: float) -> None:
        # The latches of a failed write may never be stored.
        end_ns = clock.mono_ns() + seconds * NS_PER_S
        while not self.holds(latches) and not self._failed and clock.mono_ns() < end_ns:
            time.sleep(0.001)

    def take_events(self) -> list[Event]:
        now_ns = clock.mono_ns()
        write_ns, sync_ns = self._write_timer.wait_ns(now_ns), self._sync_timer.wait_ns(now_ns)
        if self._written_latches is self._newest_latches:
            # A slow write does not matter if the file already contains the newest latches.
            write_ns = 0
        hangs = not self._failed and max(write_ns, sync_ns) > HANG_TIMEOUT_S * NS_PER_S
        if hangs is not self._hangs:
            self._hangs = hangs
            if hangs:
                text = unwritable(self.where, DISK_HANGS)
                self._news.put(Event("latch_file", text, "warning"))
            elif not self._failed:
                self._news.put(self._again)
        return self._news.take() if self._news.waiting else []

    @property
    def trouble(self) -> str:
        if not all(thread.is_alive() for thread in self._threads):
            return "the thread that writes stops to the latch file has ended; restart the daemon"
        failed = self._failed or (DISK_HANGS if self._hangs else "")
        return unwritable(self.where, failed) if failed else ""

    @property
    def _again(self) -> Event:
        return Event(
            "latch_file",
            f"the daemon can write {self.where} again, so stops survive a restart of the daemon",
        )

    def close(self) -> None:
        """Wait at most `CLOSE_TIMEOUT_S` until the latches are synced, and end both threads."""
        end_ns = clock.mono_ns() + CLOSE_TIMEOUT_S * NS_PER_S
        for box, thread in zip((self._box, self._renamed), self._threads, strict=False):
            box.close()
            thread.join(max(0.0, (end_ns - clock.mono_ns()) / NS_PER_S))

    # The writing thread runs the methods below.

    def _work(self, now: Instant) -> None:
        latches: Latches | None = None
        while True:
            # Read `closed` before the latches, so that the last latches are not missed.
            over = self._box.closed
            latches = self._box.pop() or latches
            if latches is not None and not self._try(latches, now):
                latches = None
                if not over:
                    time.sleep(MIN_WRITE_PAUSE_S)
            if over:
                return
            self._box.wait(None if latches is None else RETRY_PAUSE_S)

    def _try(self, latches: Latches, now: Instant) -> str:
        # Why that fails; `now` is the daemon's start.
        self._write_timer.begin()
        with self._disk:
            if self._blind:
                self._read_late(now)
            trouble = self._replace(latches)
        if trouble:
            self._fail(trouble)
        self._write_timer.end()
        return trouble

    def _read_late(self, now: Instant) -> None:
        # The next write would overwrite what `start()` could not read in time.
        self._blind = False
        if self._start_latches is None:
            try:
                self._start_latches = self._read(now)
            except InUseError:
                # `_barred` says why the file is not written.
                self._start_latches = Latches()
        self._missed = replace_fields(self._start_latches, stop=None)

    def _replace(self, latches: Latches) -> str:
        if self._path is None or self._barred:
            return self._barred
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # The rename comes before the sync. A process is killed far more often than the power
            # fails, and a sync takes up to seconds on an SD card. A power cut in between may leave
            # half a file, which counts as unreadable: the robot then starts stopped.
            content = encode(self._robot, self._with_missed(latches))
            replace(self._path, content, synced=False)
        except OSError as error:
            return _reason(error)
        self._written_latches = latches
        self._renamed.put(latches)
        return ""

    # The syncing thread runs the methods below.

    def _sync_each(self) -> None:
        failed = False
        while True:
            # Read `closed` before the latches, so that the last latches are not missed.
            over = self._renamed.closed
            if failed:
                # The kernel may have dropped the bytes that it could not sync, so write them again.
                with self._disk:
                    assert self._written_latches is not None
                    self._replace(self._written_latches)
            if self._renamed.pop() is not None:
                self._sync_timer.begin()
                trouble = self._sync()
                self._sync_timer.end()
                failed = bool(trouble)
                if failed:
                    self._fail(trouble)
                elif self._newest_latches is None or self._written_latches is self._newest_latches:
                    # If the newest latches are not written yet, the recovery is reported later.
                    self._recover()
            if over:
                return
            self._renamed.wait(RETRY_PAUSE_S if failed else None)

    def _sync(self) -> str:
        assert self._path is not None
        try:
            sync(self._path)
            sync(self._path.parent)
        except OSError as error:
            return _reason(error)
        return ""

    def _with_missed(self, latches: Latches) -> Latches:
        # A fault of `latches` replaces the missed one for good; so does "inactive". `_missed` has
        # no stop, because `start()` has set one.
        missed = self._missed
        if latches.fault is not None:
            missed = replace_fields(missed, fault=None)
        if latches.inactive is not None:
            missed = replace_fields(missed, inactive=None)
        self._missed = missed
        return Latches(
            latches.stop,
            latches.fault or missed.fault,
            latches.inactive or missed.inactive,
        )

    def _fail(self, reason: str) -> None:
        if reason == self._failed:
            return
        self._failed = reason
        then = (
            "the daemon does not try again: correct this, and restart the daemon"
            if self._barred
            else f"the daemon tries again every {RETRY_PAUSE_S:g} s"
        )
        text = f"{unwritable(self.where, reason)}; {then}"
        self._news.put(Event("latch_file", text, "warning"))

    def _recover(self) -> None:
        if self._failed and not self._barred:
            self._failed = ""
            self._news.put(self._again)


def _content(path: Path) -> bytes:
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


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
