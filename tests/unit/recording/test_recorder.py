"""Tests of the recorder: the control loop never waits for it, and the disk may fail in any way."""

from __future__ import annotations

import asyncio
import errno
import os
import resource
import shutil
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.link.serial_output import Offered
from acsard.core.robot import Robot
from acsard.core.values import (
    NS_PER_S,
    Cause,
    Event,
    Heard,
    Instant,
    Latches,
    News,
)
from acsard.recording import recorder as module
from acsard.recording.file import Failure, Head, Recording, Waits, listed
from acsard.recording.recorder import Recorder
from acsard.recording.replay import Playback
from tests.scenarios.taped import Tape, recorded_world
from tests.scenarios.world import START, World

SECRET = "PRIVATE KEY of a robot"
BUG = "a part that is never zero"


def config(where: Path, megabytes: float = 10.0) -> Config:
    return replace(Config(), record=RecordConfig(str(where), megabytes))


class Bench:
    """A simulated world whose recorder writes only when the test calls `write`."""

    def __init__(
        self,
        where: Path,
        monkeypatch: pytest.MonkeyPatch,
        latches: Latches = Latches(),  # noqa: B008
    ) -> None:
        monkeypatch.setattr(module, "WRITE_PAUSE_S", 1000.0)
        monkeypatch.setattr(module, "CLOSE_S", 20.0)
        self.said: list[Event] = []
        self.where = where
        self.recorder = Recorder(config(where), self.said.append)
        self.world = World(config(where), recorder=self.recorder, latches=latches)

    def write(self) -> None:
        """Do the work that the recorder's thread does once a second."""
        self.recorder._writer.write(self.recorder._take_queue(), False)

    def drive(self, seconds: float) -> None:
        """Continue the drive for this time, and let the recorder write after each second."""
        for _ in range(round(seconds)):
            self.world.hold(0.5, 0.2, seconds=1.0)
            self.write()

    def end(self) -> list[Path]:
        self.recorder.close()
        return listed(self.where)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def played(paths: list[Path]) -> Playback:
    """Replay the files as one recording; there must be no difference and no damage."""
    recording = Recording(paths)
    playback = Playback(recording)
    for _ in playback.steps():
        pass
    assert playback.comparison.same
    assert playback.comparison.exact
    assert recording.damage == []
    return playback


def numbers_of(paths: list[Path]) -> list[int]:
    return [step.number for step in Recording(paths).steps()]


def heads_of(paths: list[Path]) -> list[Head]:
    return [record for record in Recording(paths).records() if isinstance(record, Head)]


def test_a_recorded_drive_replays_bit_by_bit(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    paths = bench.end()
    playback = played(paths)
    assert (len(paths), playback.gaps) == (1, [])
    assert playback.comparison.steps == bench.world.steps
    assert [event.text for event in bench.said] == [f"the daemon records to {bench.where}"]
    assert bench.recorder.status.missing == 0


def test_a_drive_that_begins_with_kept_latches_replays_bit_by_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = Cause(5, "stop", "stopped", "stopped by ann", by="ann", at_ns=START.wall_ns, kept=True)
    bench = Bench(tmp_path, monkeypatch, latches=Latches((stop,), 5))
    bench.world.drive(0.5, 0.2, seconds=1.0)
    assert bench.world.call("clear").success
    bench.world.drive(0.5, 0.2, seconds=1.0)
    assert bench.world.state.mode == "driving"
    assert played(bench.end()).comparison.steps == bench.world.steps


def test_a_head_comes_every_20_s_and_a_file_after_an_hour_and_each_replays_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FILE_NS", 50 * NS_PER_S)
    bench = Bench(tmp_path, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(100.0)
    paths = bench.end()
    assert len(paths) == 2
    heads = [head.mono_ns for head in heads_of(paths)]
    assert max(b - a for a, b in pairwise(heads)) <= 20.02 * NS_PER_S
    assert len(heads) == 6  # every 20 s, and for the second file
    assert sum(played([path]).comparison.steps for path in paths) == bench.world.steps
    assert played(paths).gaps == []


def test_a_file_ends_at_a_fiftieth_of_the_limit(bench: Bench) -> None:
    bench.recorder._writer._directory.file_bytes = 20_000
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(30.0)
    paths = bench.end()
    assert len(paths) > 1
    assert played(paths).comparison.steps == bench.world.steps


def test_a_changed_setting_is_in_the_next_head(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    assert bench.world.call("set", b'{"settings": {"limits.linear_speed": 0.25}}').success
    bench.drive(21.0)
    first, second = heads_of(bench.end())
    assert "linear_speed = 0.25" in second.config
    assert "linear_speed = 0.25" not in first.config


def test_a_kill_costs_what_was_not_written(bench: Bench) -> None:
    """Nothing is written at the end of a file that a reader needs."""
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(3.0)
    count = bench.world.steps
    bench.world.hold(0.5, seconds=0.9)
    (path,) = listed(bench.where)
    copy = bench.where / "copy"
    copy.write_bytes(path.read_bytes())
    assert played([copy]).comparison.steps == count


@pytest.mark.parametrize("hours", [1, -1])
def test_a_set_clock_begins_a_new_file(
    hours: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    bench.world.wall_offset_ns += hours * 3600 * NS_PER_S
    bench.drive(3.0)
    paths = bench.end()
    assert len(paths) == 2
    assert played(paths).gaps == []
    first, second = heads_of(paths)
    at_ns = START.wall_ns + hours * 3600 * NS_PER_S
    found = list(Recording(paths, at_ns, at_ns + 60 * NS_PER_S).steps())
    assert {step.number for step in found} >= set(range(second.number, bench.world.steps))
    found = list(Recording(paths, START.wall_ns, START.wall_ns + 2 * NS_PER_S).steps())
    assert found[0].number == first.number


def test_if_the_queue_is_full_steps_are_lost_and_counted_and_the_loop_never_waits(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_QUEUED_STEPS", most := 1000)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    while bench.recorder.status.missing == 0:
        bench.world.hold(0.5, 0.2, seconds=1.0)
    trouble = "the disk is too slow, so steps of the recording are lost"
    assert bench.recorder.status.trouble == trouble
    bench.world.hold(0.5, 0.2, seconds=1.0)
    assert len(bench.recorder._queue) == most
    bench.drive(3.0)
    missing = bench.recorder.status.missing
    assert bench.recorder.status.trouble == ""
    assert missing > 100
    paths = bench.end()
    assert [event.text for event in bench.said] == [
        "the disk is too slow, so steps are missing in the recording",
        f"the daemon records to {bench.where}",
    ]
    playback = played(paths)
    assert playback.comparison.steps == bench.world.steps - missing
    assert [gap.steps for gap in playback.gaps] == [missing]


def test_what_sources_wait_for_is_recorded_as_soon_as_the_queue_has_room(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_QUEUED_STEPS", 1000)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    while bench.recorder.status.missing == 0:
        bench.world.hold(0.5, 0.2, seconds=1.0)
    waits = {"teleop": Reason("higher", "app has priority")}
    monkeypatch.setattr(Robot, "waits", lambda *_: waits)
    bench.world.hold(0.5, 0.2, seconds=2.0)
    bench.drive(3.0)
    records = Recording(bench.end()).records()
    (recorded,) = [record for record in records if isinstance(record, Waits)]
    assert recorded.reasons == {"teleop": ("higher", "app has priority")}


@contextmanager
def slow_syncs(bench: Bench, seconds: float, stalls: bool = False) -> Iterator[None]:
    """Make each write last this long, s.

    The robot drives meanwhile, or this process stalls.
    """
    fstat = os.fstat

    def slow(handle: int) -> os.stat_result:
        if stalls:
            bench.world.stall(seconds)
        else:
            bench.world.hold(0.5, 0.2, seconds=seconds)
        return fstat(handle)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fstat", slow)
        yield


def test_a_disk_that_hangs_is_reported_after_three_seconds_and_so_is_its_return(
    bench: Bench,
) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    bench.said.clear()
    with slow_syncs(bench, 2.9):
        bench.write()
    assert (bench.said, bench.recorder.status.trouble) == ([], "")
    with slow_syncs(bench, 3.2):
        bench.write()
    words = "the disk has accepted no data for 3 s"
    assert [(e.text, e.level) for e in bench.said] == [(f"{words}; driving goes on", "warning")]
    assert bench.recorder.status.trouble == words
    bench.drive(2.0)
    bench.world.run(0.1)
    assert bench.recorder.status.trouble == ""
    assert bench.said[1:] == [
        Event("recording", "the disk is fast enough again; no steps are missing in the recording")
    ]


def test_a_disk_that_takes_long_for_every_write_is_reported_once(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.write()
    with slow_syncs(bench, 3.5):
        bench.drive(4.0)
    works = f"the daemon records to {bench.where}"
    assert [e.level for e in bench.said if e.text != works] == ["warning"]


def test_a_process_that_did_not_run_is_not_a_disk_that_hangs(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.write()
    with slow_syncs(bench, 5.0, stalls=True):
        bench.drive(3.0)
    assert {event.level for event in bench.said} == {"info"}


def test_a_disk_that_refuses_is_reported_and_tried_again_and_driving_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = tmp_path / "record"
    where.write_bytes(b"no directory")
    bench = Bench(where, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    assert "record: File exists" in bench.recorder.status.trouble
    assert bench.recorder.status.missing > 100
    assert bench.world.state.recording_error == bench.recorder.status.trouble
    where.unlink()
    bench.drive(7.0)
    assert bench.recorder.status.trouble == ""
    assert [event.level for event in bench.said] == ["warning", "info"]
    missing = bench.recorder.status.missing
    because = f"(the error was: {where}: File exists)"
    again = f"the daemon records to {where} again; {missing} steps are missing"
    assert bench.said[-1].text == f"{again} {because}"
    paths = bench.end()
    assert played(paths).comparison.steps == bench.world.steps - missing
    assert numbers_of(paths)[0] == missing


def test_a_loop_of_symbolic_links_is_reported_and_the_recorder_tries_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, other = tmp_path / "record", tmp_path / "other"
    where.symlink_to(other)
    other.symlink_to(where)
    bench = Bench(where, monkeypatch)
    monkeypatch.setenv("ACSARD_RECORD", str(where))
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    assert str(where) in bench.recorder.status.trouble
    other.unlink()
    other.mkdir()
    bench.drive(7.0)
    assert bench.recorder.status.trouble == ""
    assert len(bench.end()) == 1


def test_a_directory_that_was_removed_is_reported_and_created_again(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    shutil.rmtree(bench.where)
    bench.drive(1.0)
    assert "was removed" in bench.recorder.status.trouble or bench.said[-1].level == "warning"
    bench.drive(module.RETRY_ROUNDS + 3.0)
    status = bench.recorder.status
    assert status.trouble == ""
    assert status.missing > 0
    assert played(bench.end()).gaps == []


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
def test_steps_that_a_full_disk_refused_are_counted_exactly(room: int, bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(3.0)
    (path,) = listed(bench.where)
    with files_of_at_most(path.stat().st_size + room):
        bench.drive(9.0)
        assert bench.recorder.status.trouble.endswith("File too large") == (room < 200_000)
    bench.drive(7.0)
    assert bench.recorder.status.trouble == ""
    paths = bench.end()
    numbers = numbers_of(paths)
    assert numbers == sorted(set(numbers))
    assert bench.recorder.status.missing == bench.world.steps - len(numbers)
    assert all(numbers_of([path]) for path in paths), "a file without steps is removed"
    played(paths)


def break_robot(patched: pytest.MonkeyPatch) -> None:
    """Let each step with a request fail."""
    hear = Robot.hear

    def broken(robot: Robot, now: Instant, heard: Heard) -> News:
        if heard.requests:
            raise ZeroDivisionError(BUG)
        return hear(robot, now, heard)

    patched.setattr(Robot, "hear", broken)


def failure_of(paths: list[Path]) -> Failure:
    *_, last = Recording(paths).records()
    assert isinstance(last, Failure)
    return last


@pytest.mark.parametrize("broken", ["robot", "port"])
def test_a_bug_of_the_daemon_is_recorded_with_the_inputs_of_the_failed_step(
    broken: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)

    def offer(line: bytes, now: Instant) -> Offered:
        raise ZeroDivisionError(BUG)

    with monkeypatch.context() as patched:
        if broken == "robot":
            break_robot(patched)
        else:
            patched.setattr(bench.world.port, "offer", offer)
        with pytest.raises(ZeroDivisionError) as raised:
            bench.world.call("stop")
        bench.recorder.close(ExceptionGroup("of a task", [raised.value]))
        (path,) = listed(bench.where)
        here = played([path]).failed_step()
    failure = failure_of([path])
    assert failure.number == bench.world.steps
    assert failure.why == f"ZeroDivisionError: {BUG}"
    assert failure.heard is not None
    # The bus delivers a called stop as an arrival and as a query.
    assert [request.verb for request in failure.heard.requests] == ["stop", "stop"]
    playback = played([path])
    assert playback.comparison.steps == failure.number
    assert "does not fail in this version" in playback.failed_step()
    assert ("also fails here, with ZeroDivision" in here) is (broken == "robot")


def test_a_bug_in_the_first_step_is_recorded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.world.bus.arrivals.append(Arrival("stop", True, b"", "", bench.world.now_ns, None, ""))
    break_robot(monkeypatch)
    with pytest.raises(ZeroDivisionError) as raised:
        bench.world.run(1.0)
    bench.recorder.close(raised.value)
    assert failure_of(listed(bench.where)).number == 0


def test_a_bug_whose_text_cannot_be_produced_is_still_recorded(bench: Bench) -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise ValueError

    bench.world.run(1.0)
    bench.recorder.close(MuteError())
    assert failure_of(listed(bench.where)) == Failure(bench.world.steps, "MuteError")


def test_inputs_that_cannot_be_encoded_are_left_out(bench: Bench) -> None:
    bench.world.run(1.0)
    tape = Tape()
    World(recorder=tape).run(0.1)
    bench.recorder.died(tape.taken[0].now, replace(tape.taken[0].heard, missed=1 << 80))
    bench.recorder.close(OverflowError("a name that is none: \udc80" + "x" * 1000))
    failure = failure_of(listed(bench.where))
    assert failure.heard is None
    assert failure.why.startswith("OverflowError: a name that is none: ")
    assert len(failure.why) < 300
    played(listed(bench.where))


@pytest.mark.parametrize("error", [None, asyncio.CancelledError()])
def test_a_requested_end_is_not_a_bug(error: BaseException | None, bench: Bench) -> None:
    bench.world.run(1.0)
    bench.recorder.close(error)
    assert played(listed(bench.where)).failure is None


def test_an_internal_error_that_ends_the_recorder_is_logged_at_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    bench.world.run(1.0)
    tape = Tape()
    World(recorder=tape).run(0.1)
    step = tape.taken[0]
    bench.recorder._queue.append(step._replace(heard=replace(step.heard, missed=1 << 80)))
    bench.recorder._over.set()
    bench.recorder._thread.join(20.0)
    bench.world.run(0.1)
    assert bench.said[-1].text.startswith("the recorder has ended because of an internal error")
    assert "the recorder has ended" in bench.recorder.status.trouble


def test_a_disk_that_hangs_delays_the_end_of_the_daemon_only_briefly(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes = threading.Event()
    bench.world.run(1.0)
    monkeypatch.setattr(module, "CLOSE_S", 0.01)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", lambda _: goes.wait(60.0))
        bench.recorder.close()
        assert bench.recorder._thread.is_alive()
    goes.set()
    bench.recorder._thread.join(20.0)


def test_the_control_loop_only_appends_to_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop runs a thousand steps while the recorder's thread waits for a sync."""
    asked, goes, sync = threading.Event(), threading.Event(), os.fsync
    thread_names = set[str]()

    def hangs(handle: int) -> None:
        thread_names.add(name := threading.current_thread().name)
        asked.set()
        if name == "record":
            goes.wait(20.0)
        sync(handle)

    monkeypatch.setattr(os, "fsync", hangs)
    monkeypatch.setattr(module, "WRITE_PAUSE_S", 0.01)
    monkeypatch.setattr(module, "CLOSE_S", 20.0)
    tape, world = recorded_world()
    world.drive(0.5, seconds=0.5)
    step = tape.taken[-1]
    recorder = Recorder(config(tmp_path), lambda event: None)
    recorder.step(step, world.loop.robot, world.loop._guard)
    assert asked.wait(20.0)
    before = len(recorder._queue)
    for _ in range(1000):
        recorder.step(step, world.loop.robot, world.loop._guard)
    hung = not goes.is_set()
    assert (len(recorder._queue) - before, thread_names, hung) == (1000, {"record"}, True)
    assert recorder._queue[-1] is step
    goes.set()
    recorder.close()
    assert len(numbers_of(listed(tmp_path))) == 1001


def test_recordings_name_the_paths_of_keys_and_contain_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificates, where = tmp_path / "tls", tmp_path / "record"
    certificates.mkdir()
    for name in ("ca.pem", "robot.pem", "robot-key.pem"):
        (certificates / name).write_text(f"-----BEGIN {SECRET} {name}-----")
    plain = config(where)
    bus = replace(
        plain.bus, tls=str(certificates), listen=("tcp/127.0.0.1:7448", "tls/0.0.0.0:7449")
    )
    monkeypatch.setattr(module, "CLOSE_S", 20.0)
    monkeypatch.setenv("ACSARD_SECRET", SECRET)
    recorder = Recorder(replace(plain, bus=bus), lambda event: None)
    world = World(replace(plain, bus=bus), recorder=recorder)
    world.put("cmd/app", f'{{"password": "{SECRET}"}}'.encode())
    world.drive(0.3, 0.0, 0.5)
    recorder.close()
    (path,) = listed(where)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    records = list(Recording([path]).records())
    assert len(records) > 100
    assert SECRET not in repr(records)
    assert str(certificates) in heads_of([path])[0].config


def test_an_error_while_a_file_begins_leaves_no_file(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    bench.world.drive(0.5, seconds=1.0)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        bench.drive(14.0)
    assert bench.recorder.status.trouble == f"{bench.where}: No space left on device"
    assert len([event for event in bench.said if event.level == "warning"]) == 1
    assert listed(bench.where) == []
    bench.drive(7.0)
    assert bench.recorder.status.trouble == ""
    assert len(bench.end()) == 1
