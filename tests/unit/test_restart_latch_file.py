"""A stop survives a restart: the latch file on disks that are full, fail or hang."""

from __future__ import annotations

import _thread
import asyncio
import errno
import fcntl
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, ControlConfig
from acsard.core.motion.latches import after_restart
from acsard.core.values import NS_PER_S, Cause, Instant, Latches
from acsard.daemon import latch_file as module
from acsard.daemon.latch_file import (
    DISK_HANGS,
    MAX_BYTES,
    Disk,
    Keeper,
    LatchFile,
    encode,
    place,
)
from acsard.host import clock
from acsard.host.errors import InUseError
from tests.faults import BROKEN, FULL, HANGS, FaultyDisk
from tests.system.harness import until

NOW = Instant(7_000_000_000, 1_800_000_000_000_000_000)
AT_NS = NOW.wall_ns
JOE = Cause(5_000_001, "stop", "stopped", "stopped by joe", by="joe", at_ns=AT_NS)
RUNAWAY = Cause(5_000_002, "fault", "wheel_runaway", "a wheel runs", "front_left", at_ns=AT_NS)
PAGE = Cause(5_000_003, "inactive", "switched_off", "switched off by page", by="page", at_ns=AT_NS)
STOP, FAULT = Latches((JOE,), 5_000_001), Latches((RUNAWAY,), 5_000_002)
OFF, ALL = Latches((PAGE,), 5_000_003), Latches((JOE, RUNAWAY, PAGE), 5_000_003)
NONE = Latches(last=5_000_000)
NAME = "acsar.latches.json"

SAID = {FULL: "No space left on device", BROKEN: "Input/output error", HANGS: DISK_HANGS}
Started = Callable[..., LatchFile]


def config(where: Path | str) -> Config:
    return replace(Config(), control=ControlConfig(state_directory=str(where)))


@pytest.fixture(autouse=True)
def _traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `coverage run` see the threads that are no objects of `threading`."""
    start, trace = _thread.start_new_thread, threading.gettrace()

    def traced(work: Callable[[], object], _: tuple[()]) -> int:
        def seen() -> None:
            sys.settrace(trace)
            work()

        return start(seen, ())

    if trace is not None:
        monkeypatch.setattr(_thread, "start_new_thread", traced)


@pytest.fixture(name="started")
def _started() -> Iterator[Started]:
    """Yield a function that starts a robot's latch file, and end the files after the test."""
    files: list[tuple[LatchFile, Disk | None]] = []

    def start(where: Path | str, disk: Disk | None = None) -> LatchFile:
        file = LatchFile(config(where), {}, disk)
        files.append((file, disk))
        asyncio.run(file.start(NOW))
        if isinstance(disk, FaultyDisk) and not disk.faults:
            until(lambda: file.is_stored)
        return file

    yield start
    for file, disk in files:
        if isinstance(disk, FaultyDisk):
            disk.goes.set()
        end(file)


def end(file: LatchFile) -> None:
    """Close the latch file as the daemon's end does: write it a last time and release the lock.

    The daemon's end waits for 0.3 s; the disk of a busy machine may take longer.
    """
    file.close()
    if file._thread.is_alive():
        file._thread.join(10.0)
    if file._lock >= 0:
        os.close(file._lock)
        file._lock = -1


def kept(latches: Latches) -> tuple[Cause, ...]:
    """Return the causes as the next start has them."""
    return after_restart(latches).causes


def stopped_at_start(file: LatchFile) -> str:
    """Return the texts of the stops that the daemon itself has set; "" without one."""
    causes = file.latches.causes
    return "; ".join(cause.text for cause in causes if cause.code == "stopped_at_start")


def test_a_first_start_has_no_latches_and_creates_the_file(
    tmp_path: Path, started: Started
) -> None:
    file = started(tmp_path / "state" / "acsard")
    assert (file.latches.causes, file.trouble) == ((), "")
    assert (tmp_path / "state" / "acsard" / NAME).read_bytes() == encode("acsar", file.latches)


@pytest.mark.parametrize("latches", [STOP, FAULT])
def test_latches_are_in_force_at_the_next_start_until_they_are_cleared(
    latches: Latches, tmp_path: Path, started: Started
) -> None:
    for held in (latches, NONE):
        file = started(tmp_path)
        file.keep(held)
        end(file)
        file = started(tmp_path)
        assert file.latches.causes == kept(held)
        end(file)


def pipe(path: Path) -> None:
    # A link to /dev/null must not make the daemon of root replace /dev/null.
    os.mkfifo(path.with_name("special"))
    path.symlink_to(path.with_name("special"))


SPOILED: dict[str, Callable[[Path], object]] = {
    "empty": Path.touch,
    "half": lambda path: path.write_bytes(encode("acsar", STOP)[:80]),
    "too large": lambda path: path.write_bytes(encode("acsar", STOP) + b" " * MAX_BYTES),
    "a directory": Path.mkdir,
    "a link to nothing": lambda path: path.symlink_to(path.with_name("unmounted")),
    "a link to a pipe": pipe,
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_file_that_cannot_be_read_starts_the_robot_stopped_and_that_is_kept(
    how: str, tmp_path: Path, started: Started
) -> None:
    SPOILED[how](tmp_path / NAME)
    file = started(tmp_path)
    text = stopped_at_start(file)
    assert f"the latch file ({tmp_path / NAME}) cannot be read: " in text
    assert not (tmp_path / "special").is_file()
    end(file)
    if how == "half":
        assert started(tmp_path).latches.causes == kept(file.latches)


def test_a_name_that_cannot_be_looked_up_is_not_a_first_start(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(path: str | Path) -> os.stat_result:
        raise OSError(errno.ESTALE, f"the server is gone: {path}")

    with monkeypatch.context() as patched:
        patched.setattr(os, "lstat", fails)
        assert stopped_at_start(started(tmp_path))


def linked(directory: Path) -> tuple[Path, Path]:
    """Make a state directory whose latch file links to one without latches on another partition."""
    state, file = directory / "state", directory / "persistent" / "robot.json"
    state.mkdir()
    file.parent.mkdir()
    file.write_bytes(encode("acsar", NONE))
    (state / NAME).symlink_to("../persistent/robot.json")
    return state, file


def test_a_stop_is_written_to_the_target_of_a_link_and_synced_there(
    tmp_path: Path, started: Started
) -> None:
    """The state directory may be volatile, and the link may lead to a partition that is not."""
    (state, target), disk = linked(tmp_path), FaultyDisk()
    target.with_name(".robot.json.k1ll3d").touch()
    file = started(state, disk)
    assert file.latches.causes == ()
    file.keep(STOP)
    end(file)
    assert (state / NAME).is_symlink()
    assert target.read_bytes() == encode("acsar", STOP)
    assert [path for call, path, _ in disk.calls if call == "sync"] == [target, target.parent] * 2
    assert os.listdir(state) == [NAME]
    assert sorted(os.listdir(target.parent)) == ["robot.json", "robot.lock"]
    assert started(state).latches.causes == kept(STOP)


def test_a_second_daemon_of_the_same_file_does_not_start(tmp_path: Path, started: Started) -> None:
    state, target = linked(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    (other / NAME).symlink_to(target)
    started(state)
    for directory in (state, other):
        with pytest.raises(InUseError, match=re.escape(str(target))):
            started(directory)


def test_a_file_system_without_lists_and_locks_still_keeps_latches(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(Path, "glob", without)
    end(started(tmp_path))
    monkeypatch.setattr(fcntl, "flock", without)
    file = started(tmp_path)
    file.keep(STOP)
    end(file)
    assert started(tmp_path).latches.causes == kept(STOP)


def test_without_a_directory_that_can_be_used_the_robot_starts_stopped(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    file = started(tmp_path / "file")
    assert "cannot be written" in stopped_at_start(file)
    assert file.trouble

    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    for directory in ("", "~nobody-has-this-name/acsard"):
        assert "control.state_directory" in stopped_at_start(started(directory))


def test_the_latch_file_is_in_the_first_place_that_is_set() -> None:
    service, user = {"STATE_DIRECTORY": "/var/lib/acsard:/var/lib/b"}, {"XDG_STATE_HOME": "/u"}
    assert place(config(Path("/mine")), service | user) == Path("/mine") / NAME
    assert place(Config(), service | user) == Path("/var/lib/acsard") / NAME
    assert place(Config(), user) == Path("/u/acsard") / NAME
    assert place(Config(), {}) == Path.home() / ".local/state/acsard" / NAME
    # The specification of the variable says that a relative path must be ignored.
    assert place(Config(), {"XDG_STATE_HOME": "state"}) == place(Config(), {})
    assert place(config(Path("~/mine")), {}) == Path.home() / "mine" / NAME


# faults of the disk


def levels(file: LatchFile) -> list[str]:
    """Return the levels of the new events of the file, as a control step takes them."""
    return [event.level for event in file.take_events()]


@pytest.mark.parametrize(
    ("call", "fault", "stops", "is_trouble"),
    [
        # What was on the disk cannot be known, so the robot starts stopped.
        ("read", BROKEN, True, False),
        ("read", HANGS, True, False),
        # The run before may have lost a stop for the same reason.
        ("write", FULL, True, True),
        ("write", HANGS, True, True),
        # The file has all latches, and a power cut may lose them.
        ("sync", HANGS, False, True),
    ],
)
def test_a_fault_of_the_disk_at_the_start(
    call: str, fault: int, stops: bool, is_trouble: bool, tmp_path: Path, started: Started
) -> None:
    (tmp_path / NAME).write_bytes(encode("acsar", OFF))
    disk = FaultyDisk(**{call: fault})
    file = started(tmp_path, disk)
    latches = file.latches
    assert (SAID[fault] in stopped_at_start(file)) == stops
    assert (latches.causes[0] == kept(OFF)[0]) == (call != "read")
    if is_trouble:
        until(lambda: levels(file) == ["warning"])
        assert f"({tmp_path / NAME}) cannot be written: {SAID[fault]}" in file.trouble
    disk.mend()
    until(lambda: not file.take_events() and not file.trouble and file.is_stored)
    # A read that comes late changes nothing.
    assert file.latches is latches
    assert (tmp_path / NAME).read_bytes() == encode("acsar", latches)


@pytest.mark.parametrize(
    ("call", "fault"),
    [("write", FULL), ("write", HANGS), ("sync", BROKEN), ("sync", HANGS)],
)
def test_a_later_fault_of_the_disk_is_told_once_and_tried_until_it_has_gone(
    call: str, fault: int, tmp_path: Path, started: Started
) -> None:
    disk = FaultyDisk()
    file = started(tmp_path, disk)
    disk.faults = {call: fault}
    file.keep(STOP)
    assert until(lambda: levels(file)) == ["warning"]
    assert SAID[fault] in file.trouble
    began = time.monotonic()
    file.wait()  # the answer to a stop waits for a disk that hangs, and not for one that fails
    assert (time.monotonic() - began >= 0.2) == (fault == HANGS)
    assert (file.is_stored, levels(file)) == (False, [])
    content = (tmp_path / NAME).read_bytes()
    assert (content == encode("acsar", STOP)) == (call == "sync")  # a kill loses nothing then
    disk.mend()
    assert until(lambda: levels(file)) == ["info"]
    assert (file.is_stored, file.trouble) == (True, "")
    assert (tmp_path / NAME).read_bytes() == encode("acsar", STOP)


def test_only_the_newest_latches_are_written_when_the_disk_works_again(
    tmp_path: Path, started: Started
) -> None:
    disk = FaultyDisk()
    file = started(tmp_path, disk)
    disk.calls.clear()
    disk.faults = {"write": HANGS}
    file.keep(FAULT)
    until(lambda: disk.calls)
    for latches in (STOP, NONE, STOP, FAULT, STOP):
        file.keep(latches)
    disk.mend()
    end(file)
    written = [data for call, _, data in disk.calls if call == "write"]
    assert written == [encode("acsar", FAULT), encode("acsar", STOP)]


def test_the_close_waits_for_a_stuck_disk_only_until_its_timeout(
    tmp_path: Path, started: Started
) -> None:
    file = started(tmp_path, FaultyDisk(sync=HANGS))
    began = time.monotonic()
    file.close()
    assert module.CLOSE_TIMEOUT_S <= time.monotonic() - began < module.CLOSE_TIMEOUT_S + 5.0


def test_a_process_that_was_stopped_during_a_sync_does_not_report_the_disk(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FaultyDisk(sync=HANGS)
    file = started(tmp_path, disk)
    file.take_events()
    later_ns = clock.mono_ns() + int(10 * disk.hang_timeout_s * NS_PER_S)
    with monkeypatch.context() as patched:
        patched.setattr(clock, "mono_ns", lambda: later_ns)
        assert (file.take_events(), file.trouble) == ([], "")


@pytest.mark.parametrize("starts", ["threading.Thread.start", "_thread.start_new_thread"])
def test_a_process_without_room_for_a_thread_starts_the_robot_stopped(
    starts: str, tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first writes the file, the second reads it."""

    def full(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(starts, full)
    file = started(tmp_path)
    assert "can't start new thread" in stopped_at_start(file)
    if "Thread" in starts:
        file.wait()
        assert not file.is_stored
        assert file.trouble


def test_without_a_file_every_answer_is_sent_at_once_and_nothing_is_reported() -> None:
    keeper = Keeper(NONE)
    keeper.keep(STOP)
    keeper.wait()
    assert (keeper.latches, keeper.is_stored, keeper.trouble) == (STOP, True, None)
    assert keeper.take_events() == []
