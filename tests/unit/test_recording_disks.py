"""A disk may refuse, hang, fill or lose the directory: recordings suffer, the loop never waits."""

from __future__ import annotations

import errno
import io
import os
import resource
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Instant
from acsard.recording import recorder
from acsard.recording.file import SUFFIX, Recording, Waits, listed
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

    def end(self) -> None:
        """End the recording. Each step is in one file, or counted as missing."""
        self.recorder.close()
        numbers = []
        for path in listed(self.where):
            recording = Recording([path])
            found = [step.number for step in recording.steps()]
            assert found, "a file without steps is removed"
            assert recording.damage == []
            numbers += found
        assert numbers == sorted(set(numbers))
        assert self.recorder.status.missing == self.steps - len(numbers)


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Box:
    return Box(tmp_path / "record", monkeypatch)


# a call of the system fails

CALLS = {
    "mkdir": (os, "mkdir"), "open": (io, "open"), "set the mode": (os, "fchmod"),
    "sync": (os, "fsync"), "ask for room": (os, "statvfs"),
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
        *_, lost, again = box.said
        assert (lost.level, lost.text) == ("warning", f"{trouble}; driving goes on")
        assert again.text == (
            f"the daemon records to {box.where} again; {box.recorder.status.missing} steps are "
            f"missing (the error was: {trouble})"
        )
        assert [event.level for event in box.said].count("warning") == 1
    box.end()


def test_recordings_that_other_programs_pushed_off_the_disk_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(1, 31):
        path = tmp_path / f"{number:06}-20261121T070027Z{SUFFIX}"
        path.touch()
        os.truncate(path, 1_000_000)
    full = SimpleNamespace(f_blocks=1 << 20, f_bavail=0, f_frsize=4096)
    monkeypatch.setattr(os, "statvfs", lambda _: full)
    box = Box(tmp_path, monkeypatch)
    box.record(2)
    warning, begun = box.said
    assert (warning.name, warning.level) == ("recording", "warning")
    assert "recordings deleted (000001-" in warning.text
    assert begun.text == f"the daemon records to {tmp_path}"
    assert 0 < len(listed(tmp_path)) < 12
    box.recorder.close()


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


def test_a_source_that_waits_while_the_disk_refuses_does_not_end_the_recording(box: Box) -> None:
    with failing("open"):
        box.recorder._queue.append(Waits.of(STEP.now, {"teleop": Reason("higher", "app drives")}))
        box.record(1)
    box.record(recorder.RETRY_ROUNDS + 3)
    assert box.trouble == ""
    box.end()


def test_each_trouble_of_the_disk_names_the_steps_that_it_cost_itself(box: Box) -> None:
    for _ in range(2):
        box.record(2)
        before = box.recorder.status.missing
        with files_of_at_most(listed(box.where)[-1].stat().st_size):
            box.record(2)
        box.record(recorder.RETRY_ROUNDS + 3)
        own = box.recorder.status.missing - before
        assert 0 < own < box.recorder.status.missing or before == 0
        assert f" again; {own} steps are missing " in box.said[-1].text
    box.end()


def test_a_power_cut_costs_ten_seconds_at_most_and_the_disk_is_not_asked_each_second(
    box: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync, synced = os.fsync, list[int]()

    def noted(handle: int) -> None:
        sync(handle)
        synced.append(box.steps)

    monkeypatch.setattr(os, "fsync", noted)
    box.record(60)
    between = [(b - a) / RATE for a, b in pairwise([*synced, box.steps])]
    assert max(between) < 12.0
    assert len(synced) < 10
    box.end()


# a disk that hangs


@contextmanager
def slow_writes(box: Box, seconds: float) -> Iterator[None]:
    """Make each write last this long, s, while the steps go on."""
    fstat = os.fstat

    def slow(handle: int) -> os.stat_result:
        for _ in range(round(seconds * RATE)):
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
    words = "the disk is fast enough again; no steps are missing in the recording"
    assert box.said[1:] == [Event("recording", words)]
    box.said.clear()
    with slow_writes(box, 3.5):
        box.record(4)
    assert [event.level for event in box.said] == ["warning"], "once, for writes that are all slow"
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
