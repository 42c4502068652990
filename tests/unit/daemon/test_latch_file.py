"""The latch file on disks that are full, fail or hang, and whatever damages its content."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.codes import Code
from acsard.core.config.settings import Config, ControlConfig
from acsard.core.motion.latches import MAX_CAUSES, after_restart
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.values import NS_PER_S, Cause, CauseKind, Instant, Latches
from acsard.daemon import latch_file as module
from acsard.daemon.latch_file import (
    DISK_HANGS,
    FORMAT,
    MAX_BYTES,
    MAX_NUMBER,
    Keeper,
    LatchFile,
    LatchFileError,
    decode,
    encode,
    new_latches,
    place,
    unreadable,
)
from acsard.host import clock
from acsard.host.atomic_file import replace as replace_file
from acsard.host.atomic_file import sync as sync_file
from acsard.host.errors import InUseError
from tests.each import each
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

Started = Callable[..., tuple[LatchFile, Latches]]


def config(where: Path) -> Config:
    return replace(Config(), control=replace(Config().control, state_directory=str(where)))


@pytest.fixture
def started() -> Iterator[Started]:
    """Yield a function that opens latch files.

    Close them after the test as the daemon's end does.
    """
    files: list[LatchFile] = []

    def start(where: Path) -> tuple[LatchFile, Latches]:
        files.append(LatchFile(config(where), {}))
        asyncio.run(files[-1].start(NOW))
        return files[-1], files[-1].latches

    yield start
    for file in files:
        end(file)


def end(file: LatchFile) -> None:
    """Close the latch file as the daemon's end does: write it a last time and release the lock."""
    file.close()
    if file._lock >= 0:
        os.close(file._lock)
        file._lock = -1


@pytest.fixture
def file(tmp_path: Path, started: Started) -> LatchFile:
    """Return the latch file of a robot after its first start."""
    file, _ = started(tmp_path)
    until(lambda: file.is_stored)
    return file


def kept(latches: Latches) -> tuple[Cause, ...]:
    """Return the causes as the next start has them."""
    return after_restart(latches).causes


def stopped_at_start(latches: Latches) -> str:
    """Return the texts of the stops that the daemon itself has set; "" without one."""
    texts = [cause.text for cause in latches.causes if cause.code == "stopped_at_start"]
    return "; ".join(texts)


def test_a_first_start_has_no_latches_and_creates_the_file(
    tmp_path: Path, started: Started
) -> None:
    file, latches = started(tmp_path / "state" / "acsard")
    assert latches.causes == ()
    assert file.trouble == ""
    assert (tmp_path / "state" / "acsard" / NAME).read_bytes() == encode("acsar", latches)


@pytest.mark.parametrize("latches", [STOP, FAULT])
def test_latches_are_in_force_at_the_next_start(
    tmp_path: Path, started: Started, file: LatchFile, latches: Latches
) -> None:
    file.keep(latches)
    end(file)
    assert started(tmp_path)[1].causes == kept(latches)


def test_a_latch_that_was_cleared_stays_cleared(
    tmp_path: Path, started: Started, file: LatchFile
) -> None:
    file.keep(STOP)
    file.keep(NONE)
    end(file)
    assert started(tmp_path)[1].causes == ()


def half(path: Path) -> None:
    path.write_bytes(encode("acsar", STOP)[:80])


def loop(path: Path) -> None:
    path.symlink_to(path)


def link_to_nothing(path: Path) -> None:
    path.symlink_to(path.with_name("unmounted"))


def too_large(path: Path) -> None:
    path.write_bytes(encode("acsar", STOP) + b" " * MAX_BYTES)


@pytest.mark.parametrize(
    "spoil", [Path.touch, half, Path.mkdir, os.mkfifo, loop, link_to_nothing, too_large]
)
def test_a_file_that_cannot_be_read_starts_the_robot_stopped(
    tmp_path: Path, started: Started, spoil: Callable[[Path], None]
) -> None:
    spoil(tmp_path / NAME)
    _, latches = started(tmp_path)
    text = stopped_at_start(latches)
    assert f"the latch file ({tmp_path / NAME}) cannot be read: " in text
    assert "; a stop may have been lost" in text


def linked(directory: Path) -> tuple[Path, Path]:
    """Make a state directory whose latch file links to a file on another partition.

    Return the state directory and the file. The file contains no latches.
    """
    state, file = directory / "state", directory / "persistent" / "robot.json"
    state.mkdir()
    file.parent.mkdir()
    file.write_bytes(encode("acsar", NONE))
    (state / NAME).symlink_to("../persistent/robot.json")
    return state, file


def test_a_stop_is_written_to_the_target_of_a_link_and_synced_there(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state directory may be volatile, and the link may lead to a partition that is not."""
    state, target = linked(tmp_path)
    killed = target.with_name(".robot.json.k1ll3d")
    killed.touch()
    synced: list[Path] = []
    monkeypatch.setattr(module, "sync", synced.append)
    file, latches = started(state)
    assert latches.causes == ()
    file.keep(STOP)
    end(file)
    assert (state / NAME).is_symlink()
    assert target.read_bytes() == encode("acsar", STOP)
    assert set(synced) == {target, target.parent}
    assert os.listdir(state) == [NAME]
    assert sorted(os.listdir(target.parent)) == ["robot.json", "robot.lock"]
    assert started(state)[1].causes == kept(STOP)


def test_two_links_to_one_file_do_not_let_two_daemons_write_it(
    tmp_path: Path, started: Started
) -> None:
    state, target = linked(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    (other / NAME).symlink_to(target)
    started(state)
    with pytest.raises(InUseError, match=re.escape(str(target))):
        started(other)


def test_a_disk_that_fails_is_reported_with_the_target_of_the_link(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, target = linked(tmp_path)
    monkeypatch.setattr(module, "replace_file", full)
    file, latches = started(state)
    assert stopped_at_start(latches)
    assert str(target) in file.trouble


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
def test_a_link_to_a_special_file_does_not_replace_that_file(
    tmp_path: Path, started: Started, make: Callable[[Path], None]
) -> None:
    """A link to /dev/null must not make the daemon of root replace /dev/null."""
    target = tmp_path / "special"
    make(target)
    (tmp_path / NAME).symlink_to(target)
    _, latches = started(tmp_path)
    assert stopped_at_start(latches)
    assert not target.is_file()


def test_the_stop_for_a_lost_file_is_itself_kept(tmp_path: Path, started: Started) -> None:
    half(tmp_path / NAME)
    file, latches = started(tmp_path)
    end(file)
    assert started(tmp_path)[1].causes == kept(latches)


def test_a_directory_that_cannot_be_written_starts_the_robot_stopped(
    tmp_path: Path, started: Started
) -> None:
    (tmp_path / "file").touch()
    file, latches = started(tmp_path / "file")
    assert "cannot be written" in stopped_at_start(latches)
    assert file.trouble


def test_an_old_stop_in_a_directory_that_cannot_be_written_keeps_its_name(
    tmp_path: Path, started: Started, file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old stop may have been released, and a later one lost, so the robot starts stopped."""
    file.keep(STOP)
    end(file)
    monkeypatch.setattr(module, "replace_file", full)
    numbers = set()
    for _ in range(2):
        file, latches = started(tmp_path)
        assert latches.causes[0] == kept(STOP)[0]
        assert "No space left on device" in stopped_at_start(latches)
        numbers.add(latches.causes[1].number)
        assert file.trouble
        end(file)
    assert len(numbers) == 2


@pytest.mark.parametrize("directory", ["", "~nobody-has-this-name/acsard"])
def test_without_a_directory_the_robot_starts_stopped(
    directory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    file = LatchFile(replace(Config(), control=ControlConfig(state_directory=directory)), {})
    asyncio.run(file.start(NOW))
    file.close()
    assert "control.state_directory" in stopped_at_start(file.latches)


def test_the_latch_file_is_in_the_first_place_that_is_set() -> None:
    service, user = {"STATE_DIRECTORY": "/var/lib/acsard:/var/lib/b"}, {"XDG_STATE_HOME": "/u"}
    assert place(config(Path("/mine")), service | user) == Path("/mine") / NAME
    assert place(Config(), service | user) == Path("/var/lib/acsard") / NAME
    assert place(Config(), user) == Path("/u/acsard") / NAME
    assert place(Config(), {}) == Path.home() / ".local/state/acsard" / NAME
    # The specification of the variable says that a relative path must be ignored.
    assert place(Config(), {"XDG_STATE_HOME": "state"}) == place(Config(), {})
    assert place(config(Path("~/mine")), {}) == Path.home() / "mine" / NAME


def test_two_robots_in_one_directory_have_separate_files(tmp_path: Path, started: Started) -> None:
    started(tmp_path)[0].keep(STOP)
    two = replace(config(tmp_path), robot=replace(Config().robot, id="two"))
    other = LatchFile(two, {})
    asyncio.run(other.start(NOW))
    assert other.latches.causes == ()
    end(other)


def test_a_second_daemon_of_the_same_robot_does_not_start(tmp_path: Path, started: Started) -> None:
    started(tmp_path)
    with pytest.raises(InUseError):
        started(tmp_path)


def test_the_temporary_file_of_a_killed_write_is_removed(tmp_path: Path, started: Started) -> None:
    (tmp_path / f".{NAME}.k1ll3d").touch()
    started(tmp_path)
    assert not list(tmp_path.glob(f".{NAME}.*"))


def test_a_directory_that_cannot_be_listed_does_not_keep_the_daemon_from_starting(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(Path, "glob", fails)
    assert started(tmp_path)[1] is not None


def test_a_file_system_without_locks_still_keeps_latches(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(*words: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", without)
    file, _ = started(tmp_path)
    file.keep(STOP)
    end(file)
    assert started(tmp_path)[1].causes == kept(STOP)


# while it runs


def full(*words: object, **more: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Stuck:
    """A disk that hangs: no write ends until `goes` is set."""

    def __init__(self) -> None:
        self.asked, self.goes, self.contents = threading.Event(), threading.Event(), list[bytes]()

    def replace(self, file: Path, content: bytes, *, synced: bool) -> None:
        self.asked.set()
        assert self.goes.wait(10.0)
        self.contents.append(content)
        replace_file(file, content, synced=synced)


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    disk = Stuck()
    yield disk
    disk.goes.set()


def test_only_the_newest_latches_are_written_when_the_disk_works_again(
    file: LatchFile, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "replace_file", stuck.replace)
    file.keep(FAULT)
    assert stuck.asked.wait(10.0)
    for latches in (STOP, NONE, STOP, FAULT, STOP):
        file.keep(latches)
    stuck.goes.set()
    end(file)
    assert stuck.contents == [encode("acsar", FAULT), encode("acsar", STOP)]


def test_a_flood_of_stops_is_written_at_a_pace(
    file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    contents = []

    def counted(path: Path, content: bytes, *, synced: bool) -> None:
        contents.append(content)
        replace_file(path, content, synced=synced)

    monkeypatch.setattr(module, "replace_file", counted)
    began = time.monotonic()
    for number in range(40):
        file.keep(Latches((replace(JOE, number=number),), number))
        time.sleep(0.005)
    end(file)
    assert len(contents) <= (time.monotonic() - began) / module.MIN_WRITE_PAUSE_S + 2
    assert b'"number": 39' in contents[-1]


def test_latches_are_stored_when_the_disk_has_them(
    tmp_path: Path, file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill after the rename loses nothing, and a power cut after the sync."""
    syncs, goes = threading.Event(), threading.Event()

    def slow(path: Path) -> None:
        syncs.set()
        assert goes.wait(10.0)

    monkeypatch.setattr(module, "sync", slow)
    file.keep(STOP)
    try:
        assert syncs.wait(10.0)
        assert not file.is_stored
        assert (tmp_path / NAME).read_bytes() == encode("acsar", STOP)
    finally:
        goes.set()
    until(lambda: file.is_stored)


def test_latches_that_arrive_while_the_file_closes_are_written(
    tmp_path: Path, file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    pop = file._box.pop

    def late() -> Latches | None:
        latches = pop()
        if latches is FAULT:  # the thread has taken it; now a stop and the end come at once
            file.keep(STOP)
            file._box.close()
        return latches

    monkeypatch.setattr(file._box, "pop", late)
    file.keep(FAULT)
    until(lambda: not file._thread.is_alive())
    assert (tmp_path / NAME).read_bytes() == encode("acsar", STOP)


def test_each_write_syncs_the_file_and_its_directory(
    tmp_path: Path, file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(module, "sync", synced.append)
    file.keep(STOP)
    end(file)
    assert synced[-2:] == [tmp_path / NAME, tmp_path]


def test_a_wait_ends_when_the_latches_are_stored(file: LatchFile) -> None:
    file.keep(STOP)
    file.wait()
    assert file.is_stored


def test_a_wait_for_a_stuck_disk_ends_after_its_timeout(
    file: LatchFile, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "replace_file", stuck.replace)
    file.keep(STOP)
    began = time.monotonic()
    file.wait()
    assert 0.2 <= time.monotonic() - began < 5.0
    assert not file.is_stored


def test_a_wait_for_a_failing_disk_ends_immediately(
    file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "replace_file", full)
    monkeypatch.setattr(module, "MAX_ANSWER_DELAY_NS", 10 * NS_PER_S)
    file.keep(STOP)
    until(lambda: file.trouble)
    began = time.monotonic()
    file.wait()
    assert time.monotonic() - began < 5.0


def test_the_close_waits_for_a_stuck_disk_only_until_its_timeout(
    file: LatchFile, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "replace_file", stuck.replace)
    file.keep(STOP)
    began = time.monotonic()
    file.close()
    assert module.CLOSE_TIMEOUT_S <= time.monotonic() - began < module.CLOSE_TIMEOUT_S + 5.0


def test_a_disk_that_does_not_write_at_the_start_loses_no_latch_that_was_read(
    tmp_path: Path, started: Started, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / NAME).write_bytes(encode("acsar", OFF))
    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.05)
    monkeypatch.setattr(module, "replace_file", stuck.replace)
    file, latches = started(tmp_path)
    assert DISK_HANGS in stopped_at_start(latches)
    assert DISK_HANGS in file.trouble
    assert latches.causes[0] == kept(OFF)[0]
    stuck.goes.set()
    until(lambda: file.trouble == "" and file.is_stored)
    assert (tmp_path / NAME).read_bytes() == encode("acsar", latches)


def test_a_disk_that_syncs_slowly_does_not_stop_the_robot_at_the_start(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / NAME).write_bytes(encode("acsar", OFF))
    goes = threading.Event()
    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.2)
    monkeypatch.setattr(module, "sync", lambda path: goes.wait(10.0))
    try:
        assert started(tmp_path)[1].causes == kept(OFF)
    finally:
        goes.set()


def test_a_sync_that_hangs_is_reported_until_it_ends(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop is in the file's cache but not on the disk, so a power cut would lose it."""
    goes = threading.Event()
    monkeypatch.setattr(module, "sync", lambda path: goes.wait(10.0))
    file, _ = started(tmp_path)
    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.05)
    try:
        file.keep(STOP)
        until(lambda: file.take_events() and DISK_HANGS in file.trouble)
    finally:
        goes.set()
    until(lambda: file.take_events() and file.trouble == "")


def test_a_process_that_was_stopped_during_a_sync_does_not_report_the_disk(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncing, goes = threading.Event(), threading.Event()

    def sync_late(path: Path) -> None:
        syncing.set()
        assert goes.wait(10.0)

    monkeypatch.setattr(module, "sync", sync_late)
    file, _ = started(tmp_path)
    assert syncing.wait(10.0)
    file.take_events()
    later_ns = clock.mono_ns() + int(10 * module.HANG_TIMEOUT_S * NS_PER_S)
    monkeypatch.setattr(clock, "mono_ns", lambda: later_ns)
    try:
        assert (file.take_events(), file.trouble) == ([], "")
    finally:
        goes.set()


def fails_to_sync(path: Path) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_first_sync_that_fails_is_reported_and_tried_again(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RETRY_PAUSE_S", 0.01)
    monkeypatch.setattr(module, "sync", fails_to_sync)
    file, _ = started(tmp_path)
    until(lambda: file.trouble)
    monkeypatch.setattr(module, "sync", sync_file)
    until(lambda: file.trouble == "")


def test_a_first_sync_that_fails_does_not_undo_a_stop_that_came_meanwhile(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes = threading.Event()

    def fails_late(path: Path) -> None:
        assert goes.wait(10.0)
        fails_to_sync(path)

    monkeypatch.setattr(module, "RETRY_PAUSE_S", 0.01)
    monkeypatch.setattr(module, "sync", fails_late)
    file, _ = started(tmp_path)
    file.keep(STOP)
    goes.set()
    until(lambda: file.trouble)
    monkeypatch.setattr(module, "sync", sync_file)
    until(lambda: file.trouble == "")
    assert (tmp_path / NAME).read_bytes() == encode("acsar", STOP)


@pytest.mark.parametrize("name", ["latches", "<lambda>"])
def test_a_process_without_room_for_a_thread_starts_the_robot_stopped(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    usual = threading.Thread.start

    def start(self: threading.Thread) -> None:
        if self.name == name:
            raise RuntimeError("can't start new thread")
        usual(self)

    monkeypatch.setattr(threading.Thread, "start", start)
    file, latches = started(tmp_path)
    assert "can't start new thread" in stopped_at_start(latches)
    if name == "latches":
        file.wait()
        assert not file.is_stored
        assert file.trouble


def test_a_thread_that_has_ended_is_reported(file: LatchFile) -> None:
    file.close()
    assert file.trouble


def test_a_file_that_was_not_read_in_time_starts_the_robot_stopped(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / NAME).write_bytes(encode("acsar", ALL))
    goes, usual = threading.Event(), module._content

    def late(path: Path) -> bytes:
        assert goes.wait(10.0)
        return usual(path)

    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.2)
    monkeypatch.setattr(module, "_content", late)
    file, latches = started(tmp_path)
    assert DISK_HANGS in stopped_at_start(latches)
    goes.set()
    until(lambda: file.is_stored)
    assert file.latches is latches, "a read that comes late changes nothing"


@pytest.mark.parametrize("number", [errno.ESTALE, errno.EACCES])
def test_a_name_that_cannot_be_looked_up_is_not_a_first_start(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    (tmp_path / NAME).write_bytes(encode("acsar", STOP))
    usual = os.lstat

    def fails(path: str | Path) -> os.stat_result:
        if Path(path) == tmp_path / NAME:
            raise OSError(number, os.strerror(number))
        return usual(path)

    monkeypatch.setattr(os, "lstat", fails)
    _, latches = started(tmp_path)
    monkeypatch.setattr(os, "lstat", usual)
    assert stopped_at_start(latches)


def levels(file: LatchFile) -> list[str]:
    """Return the levels of the new events of the file, as a control step takes them."""
    return [event.level for event in file.take_events()]


def test_a_disk_that_hangs_later_is_reported_once_and_so_is_its_recovery(
    tmp_path: Path, started: Started, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, _ = started(tmp_path)
    until(lambda: file.is_stored)
    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.05)
    monkeypatch.setattr(module, "replace_file", stuck.replace)
    file.keep(STOP)
    assert until(lambda: levels(file)) == ["warning"]
    assert DISK_HANGS in file.trouble
    assert levels(file) == []
    stuck.goes.set()
    assert until(lambda: levels(file)) == ["info"]
    assert file.trouble == ""


def test_a_disk_that_hangs_and_then_fails_is_not_reported_as_recovered(
    tmp_path: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes = threading.Event()

    def fails_late(*words: object, **more: object) -> None:
        assert goes.wait(10.0)
        full()

    file, _ = started(tmp_path)
    until(lambda: file.is_stored)
    monkeypatch.setattr(module, "HANG_TIMEOUT_S", 0.05)
    monkeypatch.setattr(module, "replace_file", fails_late)
    file.keep(STOP)
    assert until(lambda: levels(file)) == ["warning"]
    goes.set()
    until(lambda: DISK_HANGS not in file.trouble)
    assert levels(file) == ["warning"]
    assert file.trouble


def test_a_full_disk_is_reported_once_and_retried_until_a_write_succeeds(
    tmp_path: Path, file: LatchFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RETRY_PAUSE_S", 0.01)
    tries = []

    def fails(*words: object, **more: object) -> None:
        tries.append(1)
        full()

    monkeypatch.setattr(module, "replace_file", fails)
    file.keep(STOP)
    until(lambda: len(tries) > 3)
    assert levels(file) == ["warning"]
    assert "No space left on device" in file.trouble
    monkeypatch.setattr(module, "replace_file", replace_file)
    until(lambda: file.trouble == "")
    assert levels(file) == ["info"]
    assert (tmp_path / NAME).read_bytes() == encode("acsar", STOP)


def test_without_a_file_every_answer_is_sent_at_once_and_nothing_is_reported() -> None:
    keeper = Keeper(NONE)
    keeper.keep(STOP)
    keeper.wait()
    assert (keeper.latches, keeper.is_stored, keeper.trouble) == (STOP, True, None)
    assert keeper.take_events() == []


# the content


texts = st.text(st.characters(codec=None), max_size=600)
cause = st.builds(
    Cause,
    st.integers(1, MAX_NUMBER),
    st.sampled_from(get_args(CauseKind)),
    st.sampled_from(get_args(Code)),
    texts,
    texts,
    texts,
    st.integers(-(2**63) + 1, 2**63 - 1),
)


def test_the_file_is_json_that_a_person_can_read() -> None:
    text = encode("acsar", STOP).decode()
    assert len(text.splitlines()) > 10
    assert '\n  "causes"' in text
    assert text.endswith("\n}\n")


def test_numbers_grow_over_restarts_and_a_killed_run_s_numbers_are_not_used_again() -> None:
    """The run before may have published numbers that it could not write."""
    data, lasts = encode("acsar", STOP), set()
    for _ in range(100):
        latches = decode("acsar", data)
        assert latches.causes == kept(STOP)
        assert latches.last > STOP.last
        lasts.add(latches.last)
    assert len(lasts) == 100
    lost = [new_latches().last for _ in range(100)]
    lost += [unreadable("FILE", "why", NOW).last for _ in range(100)]
    assert len(set(lost)) == 200
    assert max(lost) < 1 << 49
    assert max(lost) > 1 << 44


@given(st.lists(cause, max_size=MAX_CAUSES))
def test_no_text_of_a_client_loses_a_cause(causes: list[Cause]) -> None:
    data = encode("acsar", Latches(tuple(causes), MAX_NUMBER))
    after = decode("acsar", data).causes
    assert [one.number for one in after] == [one.number for one in causes]


def test_the_names_and_texts_of_as_many_causes_as_there_can_be_fit_into_the_file() -> None:
    causes = [replace(JOE, text="x" * 1000, by="j" * 1000)] * MAX_CAUSES
    assert len(encode("acsar", Latches(tuple(causes), MAX_NUMBER))) < MAX_BYTES


def test_half_a_file_is_refused_at_every_length() -> None:
    whole = encode("acsar", ALL)
    for length in range(len(whole) - 1):  # the last byte only ends the last line
        for half in (whole[:length], whole[:length].ljust(len(whole), b"\0")):
            with pytest.raises(LatchFileError):
                decode("acsar", half)


def test_one_flipped_bit_never_makes_a_cause_disappear() -> None:
    whole = encode("acsar", ALL)
    for bit in range(len(whole) * 8):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            after = decode("acsar", bytes(flipped))
        except LatchFileError:
            continue
        assert [cause.kind for cause in after.causes] == ["stop", "fault", "inactive"]


@given(st.binary(max_size=300))
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(LatchFileError):
        decode("acsar", data)


def test_fields_that_a_later_version_added_are_ignored() -> None:
    raw = msgspec.json.decode(encode("acsar", ALL))
    for one in raw["causes"]:
        one["later"] = {"deep": [1]}
    raw["later"] = 1
    assert decode("acsar", msgspec.json.encode(raw)).causes == kept(ALL)


@each("index", [0, 1, 2])
def test_a_cause_that_a_later_version_added_still_holds_the_robot(index: int) -> None:
    raw = msgspec.json.decode(encode("acsar", ALL))
    raw["causes"][index] |= {"code": "stopped_by_music", "text": "stopped by music"}
    latches = decode("acsar", msgspec.json.encode(raw))
    held = latches.causes[index]
    assert (held.number, held.kind) == (ALL.causes[index].number, ALL.causes[index].kind)
    assert (held.code, held.text) == ("other_version", "stopped by music (stopped_by_music)")
    assert Lifecycle(latches).mode == "fault"
    assert decode("acsar", encode("acsar", latches)).causes == latches.causes


@each(
    "data",
    [
        b"",
        b"\0" * 512,
        b"[" * 5000,
        b"[1, 2]",
        b'{"format": "3"}',
        b'{"format": 3}',
        encode("acsar", ALL).replace(b'"format": 3', b'"format": 2'),
        encode("acsar", ALL).replace(b'"format": 3', b'"format": 4'),
        encode("acsar", ALL).replace(b'"causes"', b'"cause"'),
        encode("acsar", ALL).replace(b'"last"', b'"lost"'),
        encode("acsar", ALL).replace(b'"inactive"', b'"parked"'),
        encode("acsar", replace(ALL, last=RUNAWAY.number)),
        encode("acsar", replace(ALL, last=MAX_NUMBER + 1)),
        encode("acsar", ALL).replace(b"5000001", b"0"),
        encode("acsar", ALL).replace(b"5000001", b"1" * 30),
        encode("acsar", ALL).replace(b"1800000000000000000", b"9223372036854775808"),
        encode("other", ALL),
    ],
)
def test_a_file_without_latches_of_this_robot_is_refused(data: bytes) -> None:
    with pytest.raises(LatchFileError):
        decode("acsar", data)
    assert FORMAT == 3
