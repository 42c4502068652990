"""The file that keeps stop, fault, `inactive` and lowered limits over every end of the process.

A thread writes it. The control loop only hands over the newest latches and never waits for the
disk. From the rename on, a killed process loses nothing. From the sync on, a power cut loses
nothing. The file is read once, before the robot exists. `latch_rules.py` decides what the robot
starts with.
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
from acsard.host.threads import NoThreadError, in_thread

START_S = 2.0
"""Time limit of one write, and of reading and writing at the start. A slower disk hangs."""

PACE_S = 0.05
"""Pause after each write. A flood of stops, each a new latch, must not wear out an SD card."""

RETRY_S = 1.0
"""Pause between two attempts to write a file that could not be written."""

CLOSE_S = 0.3
"""Time limit of the last write on the way down."""

HANGS = f"the disk did not answer within {START_S:g} s"

EVENTS = 64
"""Events that wait for the control loop at most. It takes them in every step."""

NO_PLACE = "no directory"
"""Stands for the path where none can be found."""


def place(config: Config, environ: Mapping[str, str]) -> Path:
    """Return the path of this robot's latch file.

    Raises:
        OSError: Neither the configuration nor the environment names a directory.
    """
    name = f"{config.robot.id}.latches.json"
    try:
        if config.control.state_directory:
            return Path(config.control.state_directory).expanduser() / name
    except RuntimeError as error:
        raise OSError(errno.ENOENT, f"control.state_directory: {error}") from None
    # systemd gives several directories with colons between them.
    service = environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service) / name
    # Its specification wants a relative path to be ignored.
    if environ.get("XDG_STATE_HOME", "").startswith("/"):
        return Path(environ["XDG_STATE_HOME"]) / "acsard" / name
    try:
        return Path.home() / ".local" / "state" / "acsard" / name
    except RuntimeError:
        raise OSError(
            errno.ENOENT,
            "this user has no home directory; set control.state_directory or $XDG_STATE_HOME",
        ) from None


class LatchFile:
    """The latch file of one robot. Call `start` once, then `keep` after every step."""

    def __init__(self, config: Config, environ: Mapping[str, str]) -> None:
        self.where = NO_PLACE
        """Path of the file, for messages."""
        self._path: Path | None = None
        self._robot = config.robot.id
        self._barred = ""
        """Why nothing may be written at all; empty if it may."""
        try:
            self._path = place(config, environ)
            self.where = str(self._path)
        except OSError as error:
            self._barred = _reason(error)
        self._lock = -1
        """Descriptor that keeps other daemons away from this file."""
        self._disk = threading.Lock()
        """Held by the thread that is at the disk; the control loop never takes it."""
        self._abandoned = False
        """True if the start has stopped waiting for the first look at the file."""
        self._found: Latches | None = None
        """The latches that the file had at the start; None until it has been read."""
        self._blind = False
        """True if the robot has started without the content, and the file is not yet written."""
        self._missed = Latches()
        """Latches in the file that the robot did not start with, since the read took too long."""
        self._box = Mailbox[Latches](1)
        """The newest latches that were handed over, until the thread takes them."""
        self._news = Mailbox[Event](EVENTS)
        self._held: Latches | None = None
        """The latches in the file."""
        self._failed = ""
        self._handed: Latches | None = None
        """The latches that were handed over last."""
        self._busy_ns: int | None = None
        """Monotonic time at which the present write began; None between two writes."""
        self._hung = False
        """True after the event that the disk hangs, until the event that it answers."""
        self._thread: threading.Thread | None = None

    # the start

    async def start(self, now: Instant) -> Latches:
        """Return the latches to start with, after reading the file and trying to write it.

        Raises:
            InUseError: Another daemon keeps the latches of a robot with this id in this file.
        """
        try:
            latches = await in_thread(lambda: self._look(now), START_S)
        except TimeoutError as error:
            self._abandoned = True
            why = str(error) if isinstance(error, NoThreadError) else HANGS
            self._fail(why)
            found = self._found
            if found is None:
                self._blind = True
                latches = stopped(Latches(), unreadable(self.where, why), now)
            else:
                latches = stopped(found, at_start(unwritable(self.where, why)), now)
            self.keep(latches)
        thread = threading.Thread(target=self._work, args=(now,), name="latches", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:
            self._fail(f"this process cannot start another thread ({error})")
            return stopped(latches, at_start(unwritable(self.where, self._failed)), now)
        self._thread = thread
        return latches

    def _look(self, now: Instant) -> Latches:
        """Read the file, decide, and write it once to see that it can be written."""
        with self._disk:
            if self._abandoned:
                return Latches()
            latches = self._found = self._read(now)
            # The thread syncs: a sync takes up to seconds on an SD card.
            trouble = self._replace(latches)
            if trouble and not self._abandoned:
                self._fail(trouble)
                latches = stopped(latches, at_start(unwritable(self.where, trouble)), now)
                self.keep(latches)
            return latches

    def _read(self, now: Instant) -> Latches:
        """Lock and read the file; raise `InUseError` if another daemon has locked it."""
        path = self._path
        if path is None:
            return Latches()
        self._take_lock(path)
        try:
            # Any other error may hide a stop. A link to nothing is there: its disk may be missing.
            os.lstat(path)
        except FileNotFoundError:
            return Latches()
        except OSError as error:
            return stopped(Latches(), unreadable(self.where, _reason(error)), now)
        try:
            return decode(self._robot, _content(path))
        except (OSError, LatchFileError) as error:
            return stopped(Latches(), unreadable(self.where, _reason(error)), now)

    def _take_lock(self, path: Path) -> None:
        """Lock out every other daemon that would write this file; raise `InUseError`."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError:
            return  # Writing the file fails too, and that is reported.
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
            return  # A file system without locks: two daemons with one id are seen on the bus.
        self._lock = lock
        # A process that was killed while it wrote has left its temporary file.
        for left in path.parent.glob(f".{path.name}.*"):
            with suppress(OSError):
                left.unlink()

    # the control loop's side

    def keep(self, latches: Latches) -> None:
        """Hand over the latches that are in force from now on."""
        self._handed = latches
        self._box.put(latches)

    def holds(self, latches: Latches) -> bool:
        """Return whether a process that is killed now would start with these latches."""
        return self._held is latches

    def wait(self, latches: Latches, seconds: float) -> None:
        """Wait until `holds` is true, at most this time."""
        end_ns = clock.mono_ns() + seconds * NS_PER_S
        while not self.holds(latches) and not self._failed and clock.mono_ns() < end_ns:
            time.sleep(0.001)

    def news(self) -> list[Event]:
        """Return the events since the last call."""
        if self._hangs is not self._hung:
            self._hung = not self._hung
            if self._hung:
                text = unwritable(self.where, HANGS)
                self._news.put(Event("latch_file", text, "warning"))
            elif not self._failed:
                self._news.put(self._again)
        return self._news.take()

    @property
    def trouble(self) -> str:
        """Why the latches in force are not kept, in words; empty if they are."""
        if self._thread is not None and not self._thread.is_alive():
            return "the thread that keeps a stop over a restart has ended; restart the daemon"
        failed = self._failed or (HANGS if self._hangs else "")
        return unwritable(self.where, failed) if failed else ""

    @property
    def _hangs(self) -> bool:
        """Return whether the newest latches wait for a write that has taken too long."""
        busy_ns = self._busy_ns
        if busy_ns is None or self._failed or self._held is self._handed:
            return False
        return clock.mono_ns() - busy_ns > START_S * NS_PER_S

    @property
    def _again(self) -> Event:
        return Event("latch_file", f"a stop is kept again in {self.where}")

    def close(self) -> None:
        """Wait a bounded time until the newest latches are written."""
        if self._thread is not None:
            self._box.close()
            self._thread.join(CLOSE_S)

    # the thread's side

    def _work(self, now: Instant) -> None:
        latches = None if self._failed else self._sync_first()
        while True:
            # Look for the end before the latches, so that the last ones are not overlooked.
            over = self._box.closed
            latches = self._box.pop() or latches
            if latches is not None and not self._try(latches, now):
                latches = None
                if not over:
                    time.sleep(PACE_S)
            if over:
                return
            self._box.wait(None if latches is None else RETRY_S)

    def _try(self, latches: Latches, now: Instant) -> str:
        """Write these latches and report a failure or a recovery; return the failure."""
        self._busy_ns = clock.mono_ns()
        with self._disk:
            if self._blind:
                self._read_late(now)
            trouble = self._write(latches)
        if trouble and trouble != self._failed:
            self._fail(trouble)
        self._busy_ns = None
        if not trouble:
            self._recover()
        return trouble

    def _sync_first(self) -> Latches | None:
        """Sync the write of the start; return the latches to write again if that fails."""
        self._busy_ns = clock.mono_ns()
        with self._disk:
            trouble = self._sync()
        self._busy_ns = None
        if not trouble or self._found is None:
            return None
        self._fail(trouble)
        return self._found

    def _read_late(self, now: Instant) -> None:
        """Read the file that the start did not read, so that no latch in it is overwritten."""
        self._blind = False
        if self._found is None:
            try:
                self._found = self._read(now)
            except InUseError:
                self._found = Latches()  # `_barred` says why nothing is written.
        self._missed = replace_fields(self._found, stop=None)

    def _write(self, latches: Latches) -> str:
        """Replace and sync the file; return the reason if that fails."""
        return self._replace(latches) or self._sync()

    def _replace(self, latches: Latches) -> str:
        """Replace the file; return the reason if that fails."""
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
        self._held = latches
        return ""

    def _sync(self) -> str:
        """Wait until the disk has the file, which `_replace` has written; return a failure."""
        assert self._path is not None
        try:
            sync(self._path)
            sync(self._path.parent)
        except OSError as error:
            return _reason(error)
        return ""

    def _with_missed(self, latches: Latches) -> Latches:
        """Return these latches with those that only the next start can put in force.

        A stop that was missed is not among them: the robot started stopped for it.
        """
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
            missed.lowered | latches.lowered,
        )

    def _fail(self, reason: str) -> None:
        self._failed = reason
        text = f"{unwritable(self.where, reason)}; the daemon tries again every {RETRY_S:g} s"
        self._news.put(Event("latch_file", text, "warning"))

    def _recover(self) -> None:
        if self._failed:
            self._failed = ""
            self._news.put(self._again)


def _content(path: Path) -> bytes:
    """Return the bytes of a small regular file; raise `OSError` for anything else."""
    # Without O_NONBLOCK a pipe of this name would block the start.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OSError(errno.EFBIG, f"it has more than {MAX_BYTES} bytes")
    return data


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
