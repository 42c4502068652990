"""A disk may refuse, hang, fill or lose the directory: recordings suffer, the loop never waits."""

from __future__ import annotations

import errno
import io
import os
import resource
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Instant
from acsard.recording import directory, recorder
from acsard.recording.directory import RecordingDirectory
from acsard.recording.file import SUFFIX, Recording, listed
from acsard.recording.recorder import Recorder
from tests.unit.drives import drive

STEP = drive().taken[-1]
RATE = 20  # steps a second, which are as good as 200 here


def config(where: Path, megabytes: float = 10.0) -> Config:
    return replace(Config(), record=RecordConfig(str(where), megabytes))


class Box:
    """A recorder that gets steps of a robot at rest, and writes only when the test says so."""

    def __init__(self, where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(recorder, "WRITE_PAUSE_S", 1000.0)
        monkeypatch.setattr(recorder, "CLOSE_S", 20.0)
        self.said: list[Event] = []
        self.where, self.steps = where, 0
        self.recorder = Recorder(config(where), self.said.append)
        self._robot = Robot(config(where))
        self._guard = Guard(b"", config(where))
        self._now = STEP.now

    def step(self, seconds: float = 1 / RATE) -> None:
        later_ns = int(seconds * NS_PER_S)
        self._now = Instant(self._now.mono_ns + later_ns, self._now.wall_ns + later_ns)
        self.recorder.step(STEP._replace(now=self._now), self._robot, self._guard)
        self.steps += 1

    def write(self) -> None:
        """Do the work that the recorder's thread does once a second."""
        self.recorder._writer.write(self.recorder._take_queue(), False)

    def record(self, seconds: int) -> None:
        for _ in range(seconds):
            for _ in range(RATE):
                self.step()
            self.write()

    @property
    def trouble(self) -> str:
        return self.recorder.status.trouble

    def end(self, too_many: int = 0) -> None:
        """End the recording. Each step is in one file, or counted as missing.

        An error after a write may count the steps of this write, too.
        """
        self.recorder.close()
        numbers = []
        for path in listed(self.where):
            recording = Recording([path])
            found = [step.number for step in recording.steps()]
            assert found, "a file without steps is removed"
            assert recording.damage == []
            numbers += found
        assert numbers == sorted(set(numbers))
        absent = self.steps - len(numbers)
        assert absent <= self.recorder.status.missing <= absent + too_many


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Box:
    return Box(tmp_path / "record", monkeypatch)


# a call of the system fails

CALLS = {
    "mkdir": (os, "mkdir"), "open": (io, "open"), "set the mode": (os, "fchmod"),
    "sync": (os, "fsync"), "ask for the file": (os, "fstat"), "ask for room": (os, "statvfs"),
}  # fmt: skip


@contextmanager
def failing(call: str) -> Iterator[None]:
    """Let a call fail as on a full disk. `open` fails for recordings only."""
    module, name = CALLS[call]
    real = getattr(module, name)

    def fails(*args: Any, **options: Any) -> Any:
        if name == "open" and not str(args[0]).endswith(SUFFIX):
            return real(*args, **options)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, name, fails)
        yield


@pytest.mark.parametrize("begun", [False, True], ids=["from the start", "in a file"])
@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_fails_is_reported_once_and_costs_steps_that_are_counted(
    call: str, begun: bool, box: Box
) -> None:
    if begun and call in ("mkdir", "open", "set the mode"):
        box.recorder._writer._directory.file_bytes = 0  # the next sync ends the file
    box.record(2 if begun else 0)
    with failing(call):
        box.record(25)
        trouble = box.trouble
    box.record(7)
    assert box.trouble == ""
    if begun and call == "mkdir":  # the directory exists
        assert trouble == ""
    else:
        assert trouble == f"{box.where}: No space left on device"
        missing = box.recorder.status.missing
        assert [(event.level, event.text) for event in box.said[-2:]] == [
            ("warning", f"{trouble}; driving goes on"),
            (
                "info",
                f"the daemon records to {box.where} again; {missing} steps are missing "
                f"(the error was: {trouble})",
            ),
        ]
        assert [event.level for event in box.said].count("warning") == 1
    box.end(too_many=RATE)


def a_file(where: Path) -> None:
    where.write_bytes(b"no directory")


def a_loop_of_links(where: Path) -> None:
    where.symlink_to(where)


@pytest.mark.parametrize(
    ("make", "why"), [(a_file, "File exists"), (a_loop_of_links, "symbolic links")]
)
def test_a_directory_that_cannot_be_made_is_tried_again(
    make: Any, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path / "record"))
    make(tmp_path / "record")
    box = Box(tmp_path / "record", monkeypatch)
    box.record(2)
    assert box.trouble.startswith(f"{box.where}: ")
    assert why in box.trouble
    box.where.unlink()
    box.record(7)
    assert box.trouble == ""
    box.end()


def test_a_directory_that_was_removed_is_reported_and_made_again(box: Box) -> None:
    box.record(2)
    shutil.rmtree(box.where)
    box.record(1)
    assert box.trouble.endswith("the file that is being recorded was removed")
    box.record(recorder.RETRY_ROUNDS + 3)
    assert box.trouble == ""
    box.recorder.close()
    assert 0 < box.recorder.status.missing < box.steps
    assert len(listed(box.where)) == 1


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Limit the size of files in bytes; writes beyond it fail as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room", [0, 20, 200_000])
def test_steps_that_a_full_disk_refused_are_counted_exactly(room: int, box: Box) -> None:
    box.record(3)
    (path,) = listed(box.where)
    with files_of_at_most(path.stat().st_size + room):
        box.record(9)
        assert box.trouble.endswith("File too large") == (room < 200_000)
    box.record(7)
    assert box.trouble == ""
    box.end()


# a disk that hangs


@contextmanager
def slow_writes(box: Box, seconds: float, stalls: bool = False) -> Iterator[None]:
    """Make each write last this long, s: the steps go on meanwhile, or the process stands still."""
    fstat = os.fstat

    def slow(handle: int) -> os.stat_result:
        if stalls:
            box.step(seconds)
        for _ in range(0 if stalls else round(seconds * RATE)):
            box.step()
        return fstat(handle)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fstat", slow)
        yield


def test_a_disk_that_hangs_is_reported_after_three_seconds_and_so_is_its_return(
    box: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "WATCH_STEPS", 1)
    box.record(2)
    box.said.clear()
    with slow_writes(box, 2.9):
        box.write()
    assert (box.said, box.trouble) == ([], "")
    with slow_writes(box, 3.2):
        box.write()
    words = "the disk has accepted no data for 3 s"
    assert [(e.text, e.level) for e in box.said] == [(f"{words}; driving goes on", "warning")]
    assert box.trouble == words
    box.record(2)
    assert box.trouble == ""
    again = Event(
        "recording", "the disk is fast enough again; no steps are missing in the recording"
    )
    assert box.said[1:] == [again]
    box.said.clear()
    with slow_writes(box, 3.5):
        box.record(4)
    assert [event.level for event in box.said] == ["warning"], "once, for writes that are all slow"
    box.end()


def test_a_process_that_did_not_run_is_not_a_disk_that_hangs(
    box: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "WATCH_STEPS", 1)
    box.record(1)
    with slow_writes(box, 5.0, stalls=True):
        box.record(3)
    assert {event.level for event in box.said} == {"info"}
    box.end()


def test_if_the_queue_is_full_steps_are_lost_and_counted_and_the_loop_never_waits(
    box: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_QUEUED_STEPS", most := 100)
    while box.recorder.status.missing == 0:
        box.step()
    assert box.trouble == "the disk is too slow, so steps of the recording are lost"
    for _ in range(50):
        box.step()
    assert len(box.recorder._queue) == most
    box.record(3)
    assert box.trouble == ""
    assert box.recorder.status.missing > 50
    assert [event.text for event in box.said] == [
        "the disk is too slow, so steps are missing in the recording",
        f"the daemon records to {box.where}",
    ]
    box.end()


def test_the_control_loop_only_appends_to_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop makes a thousand steps while the recorder's thread waits for a sync.

    The daemon's end waits for it only briefly.
    """
    asked, goes, sync, names = threading.Event(), threading.Event(), os.fsync, set[str]()

    def hangs(handle: int) -> None:
        names.add(threading.current_thread().name)
        asked.set()
        goes.wait(20.0)
        sync(handle)

    monkeypatch.setattr(os, "fsync", hangs)
    box = Box(tmp_path, monkeypatch)
    monkeypatch.setattr(recorder, "CLOSE_S", 0.01)
    box.step()
    box.recorder._over.set()
    assert asked.wait(20.0)
    for _ in range(1000):
        box.step()
    queued = sum(isinstance(item, tuple) for item in box.recorder._queue)
    assert (queued, names, goes.is_set()) == (1000, {"record"}, False)
    box.recorder.close()
    assert box.recorder._thread.is_alive()
    goes.set()
    box.recorder._thread.join(20.0)


# the directory

NOW_NS = 1_795_935_600 * NS_PER_S


def new(where: Path, megabytes: float = 10.0) -> RecordingDirectory:
    return RecordingDirectory(RecordConfig(str(where), megabytes))


def record(store: RecordingDirectory, wall_ns: int = NOW_NS, size: int = 0) -> Path:
    with store.begin(wall_ns) as file:
        file.write(bytes(size))
        return Path(file.name)


def modes(where: Path) -> list[str]:
    """Return the modes of the directory and of its files, in octal."""
    return [oct(path.stat().st_mode & 0o777)[2:] for path in (where, *listed(where))]


def numbers(where: Path) -> list[int]:
    return [int(path.name[:6]) for path in listed(where)]


def test_file_numbers_increase_whatever_the_clock_shows(tmp_path: Path) -> None:
    for wall_ns in (NOW_NS, 0, NOW_NS - 86_400 * NS_PER_S):
        record(new(tmp_path), wall_ns)
    assert numbers(tmp_path) == [1, 2, 3]
    assert listed(tmp_path)[1].name == f"000002-19700101T000000Z{SUFFIX}"


def test_no_clock_deletes_a_recording(tmp_path: Path) -> None:
    store = new(tmp_path, 30.0)
    for year in (2026, 2106, 1970, 2250, 1999):
        path = record(store, (year - 1970) * 31_556_952 * NS_PER_S, size=5_000_000)
        os.utime(path, (0, 0))
        assert store.make_room() == ""
    assert numbers(tmp_path) == [1, 2, 3, 4, 5]
    for _ in range(2):
        record(store, size=5_000_000)
        store.make_room()
    assert numbers(tmp_path) == [3, 4, 5, 6, 7], "the order is that of the numbers"


@pytest.mark.parametrize(
    ("service", "private", "umask", "wanted"),
    [
        (".", "elsewhere", 0, ["750", "640"]),
        (".", "elsewhere", 0o077, ["750", "640"]),
        # Every user may read the directory of a service that only root can enter.
        ("b", ".", 0o077, ["755", "644"]),
        (".", ".", 0, ["750", "640"]),  # it is another directory
        ("b", "elsewhere", 0, ["750", "640"]),  # everybody gets there, not only root
    ],
)
def test_the_group_or_every_user_may_read_a_recording(
    service: str, private: str, umask: int, wanted: list[str],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path / service))
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path / private)
    before = os.umask(umask)
    try:
        record(new(tmp_path / "b"))
    finally:
        os.umask(before)
    assert modes(tmp_path / "b") == wanted


@pytest.mark.skipif(os.geteuid() != 0, reason="gives a directory away")
def test_recording_works_in_a_directory_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSARD_RECORD", ".")
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o777)
    child = os.fork()
    if child == 0:
        try:
            os.setresuid(65534, 65534, 65534)
            record(new(Path()))
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert modes(tmp_path) == ["777", "644"]


class Disk(NamedTuple):
    f_blocks: int
    f_bavail: int
    f_frsize: int = 1


@pytest.mark.parametrize(
    ("files", "each_mb", "limit_mb", "total_mb", "free_mb", "kept"),
    [
        (12, 1, 10, 1e6, 1e6, 9),  # so that one more fits
        (60, 1, 1000, 1000, 40, 30),  # 60 + 40 - 50 for other programs, and 20 for the next file
        (30, 1, 10, 1000, 0, 9),  # others fill the disk: the smallest limit, less the next file
        (1, 1, 10, 0, 0, 1),  # a disk that does not report its size has room
        (1, 20, 10, 1e6, 1e6, 1),  # the newest file stays
    ],
)
def test_the_oldest_files_go_and_leave_room(
    files: int, each_mb: int, limit_mb: float, total_mb: float, free_mb: float, kept: int,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(os, "statvfs", lambda _: Disk(int(total_mb * 1e6), int(free_mb * 1e6)))
    store = new(tmp_path, limit_mb)
    for _ in range(files):
        record(store, size=each_mb * 1_000_000)
    (tmp_path / "000000-notes.txt").write_bytes(bytes(5_000_000))
    text = store.make_room()
    assert numbers(tmp_path) == [*range(files - kept + 1, files + 1)]
    assert (tmp_path / "000000-notes.txt").exists()
    if limit_mb == 1000:
        assert "30 recordings deleted (000001-" in text
        assert "only 40.0 MB of the disk were free, and recordings leave 50.0 MB" in text
    else:
        assert bool(text) == (free_mb == 0 != total_mb)


def test_a_file_that_another_process_removes_meanwhile_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = new(tmp_path)
    first, *_ = [record(store, size=8_000_000) for _ in range(3)]
    unlink, stat = Path.unlink, Path.stat

    def twice(path: Path, missing_ok: bool = False) -> None:
        unlink(path)
        unlink(path)

    def removed(path: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if path == first:
            with suppress(FileNotFoundError):
                unlink(path)
        return stat(path, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(Path, "unlink", twice)
    store.make_room()
    assert not first.exists()
    first.touch()
    monkeypatch.setattr(Path, "stat", removed)
    store.make_room()
    assert not os.path.exists(first)
