"""Tests of the recorder: the control loop never waits for it, and the disk may fail in any way."""

from __future__ import annotations

import asyncio
import errno
import os
import resource
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.link.serial_output import Offered
from acsard.core.robot import Robot
from acsard.core.values import Event, Heard, Instant, Latch, Latches, News
from acsard.recording import mcap_recorder as module
from acsard.recording import retention, step_writer
from acsard.recording.end_record import ending_text, read_end
from acsard.recording.file_replay import replay_file, steps
from acsard.recording.mcap_directory import KEPT_SUFFIX, RecordingDirectory, listed
from acsard.recording.mcap_file import About, Recording, RecordingWriter, rewrite
from acsard.recording.mcap_recorder import Recorder
from acsard.recording.recorded_steps import unfinished
from tests.scenarios.taped import Tape, recorded_world
from tests.scenarios.world import START, World

SECRET = "PRIVATE KEY of a robot"


def config(where: Path, megabytes: float = 10.0) -> Config:
    return replace(Config(), record=RecordConfig(str(where), megabytes))


class Bench:
    """A simulated world whose recorder writes only when the test calls `write`."""

    def __init__(
        self,
        where: Path,
        monkeypatch: pytest.MonkeyPatch,
        megabytes: float = 10.0,
        latches: Latches = Latches(),  # noqa: B008
    ) -> None:
        monkeypatch.setattr(module, "SYNC_PAUSE_S", 1000.0)
        monkeypatch.setattr(module, "CLOSE_S", 20.0)
        self.said: list[Event] = []
        self.where = where
        self.recorder = Recorder(config(where, megabytes), self.said.append)
        self.world = World(config(where, megabytes), recorder=self.recorder, latches=latches)

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


@pytest.mark.slow
def test_a_recorded_drive_replays_bit_by_bit(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    (path,) = bench.end()
    result = replay_file(Recording(path))
    assert (result.comparison.same, result.comparison.exact, result.gaps) == (True, True, [])
    assert result.comparison.steps == bench.world.steps
    assert [event.text for event in bench.said] == [f"the daemon records to {bench.where}"]
    assert bench.recorder.status.missing == 0


@pytest.mark.slow
def test_a_drive_that_begins_with_kept_latches_replays_bit_by_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = Latch(5, START.wall_ns, "ann", "stopped by ann", "stopped", kept=True)
    latches = Latches(stop=stop)
    bench = Bench(tmp_path, monkeypatch, latches=latches)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    assert bench.world.call("clear").success
    bench.world.drive(0.5, 0.2, seconds=1.0)
    assert bench.world.state.mode == "driving"
    (path,) = bench.end()
    result = replay_file(Recording(path))
    assert (result.comparison.same, result.comparison.exact, result.gaps) == (True, True, [])
    assert result.comparison.steps == bench.world.steps


@pytest.mark.slow
def test_a_file_that_begins_with_a_state_replays_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 3_000_000_000)
    bench = Bench(tmp_path, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(10.0)
    paths = bench.end()
    assert len(paths) > 2
    count = 0
    for path in paths:
        result = replay_file(Recording(path))
        assert (result.comparison.same, result.comparison.exact, result.gaps) == (True, True, [])
        count += result.comparison.steps
    assert count == bench.world.steps


@pytest.mark.slow
def test_if_the_queue_is_full_steps_are_lost_and_counted_and_the_loop_never_waits(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_QUEUED_STEPS", most := 1000)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    while bench.recorder.status.missing == 0:
        bench.world.hold(0.5, 0.2, seconds=1.0)
    assert (
        bench.recorder.status.trouble == "the disk is too slow, so steps of the recording are lost"
    )
    bench.world.hold(0.5, 0.2, seconds=1.0)
    assert len(bench.recorder._queue) == most
    bench.drive(3.0)
    missing = bench.recorder.status.missing
    assert bench.recorder.status.trouble == ""
    assert missing > 100
    before, after = bench.end()
    works = f"the daemon records to {bench.where}"
    texts = [event.text for event in bench.said if event.text != works]
    assert texts == [
        "the disk is too slow, so steps are missing in the recording",
        f"the disk is fast enough again; {missing} steps are missing in the recording",
    ]
    numbers = [step.number for path in (before, after) for step in steps(Recording(path))]
    assert len(numbers) == bench.world.steps - missing
    for path in (before, after):
        assert replay_file(Recording(path)).comparison.same
    assert after.name.endswith(KEPT_SUFFIX) == before.name.endswith(KEPT_SUFFIX)


@contextmanager
def slow_syncs(bench: Bench, seconds: float, stalls: bool = False) -> Iterator[None]:
    """Make each sync of the disk last this long, s.

    The robot drives during the sync, or this process stalls.
    """
    sync = os.fsync

    def slow(handle: int) -> None:
        if stalls:
            bench.world.stall(seconds)
        else:
            bench.world.hold(0.5, 0.2, seconds=seconds)
        sync(handle)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fsync", slow)
        yield


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_disk_that_takes_long_for_every_sync_is_reported_once(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.write()
    with slow_syncs(bench, 3.5):
        bench.drive(4.0)
    works = f"the daemon records to {bench.where}"
    assert [e.level for e in bench.said if e.text != works] == ["warning"]


@pytest.mark.slow
def test_a_disk_that_takes_two_seconds_for_every_sync_is_not_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first file and each new file need several syncs in a row."""
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 5_000_000_000)
    bench = Bench(tmp_path, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    with slow_syncs(bench, 2.0):
        bench.drive(8.0)
    assert {event.level for event in bench.said} == {"info"}
    assert len(bench.end()) > 2


def test_a_process_that_did_not_run_is_not_a_disk_that_hangs(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.write()
    with slow_syncs(bench, 5.0, stalls=True):
        bench.drive(3.0)
    assert {event.level for event in bench.said} == {"info"}


@pytest.mark.slow
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
    bench.drive(6.0)
    assert bench.recorder.status.trouble == ""
    levels = [event.level for event in bench.said]
    assert levels == ["warning", "info"]
    missing = bench.recorder.status.missing
    because = f"(the error was: {where}: File exists)"
    again = f"the daemon records to {where} again; {missing} steps are missing"
    assert bench.said[-1].text == f"{again} {because}"
    (path,) = bench.end()
    assert replay_file(Recording(path)).comparison.same
    assert next(steps(Recording(path))).number > 100


def test_a_loop_of_symbolic_links_is_reported_and_the_recorder_tries_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, other = tmp_path / "record", tmp_path / "other"
    where.symlink_to(other)
    other.symlink_to(where)
    bench = Bench(where, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    assert bench.recorder.status.trouble == f"{where}: Too many levels of symbolic links"
    other.unlink()
    other.mkdir()
    bench.drive(6.0)
    assert bench.recorder.status.trouble == ""
    assert len(bench.end()) == 1


def happen_stop(world: World) -> None:
    world.call("stop")


def happen_loss(world: World) -> None:
    world.port.unplug()
    world.run(0.5)
    world.port.plug(world.mcu)


def happen_silence(world: World) -> None:
    with world.mcu.mute():
        world.run(0.5)


def happen_fault(world: World) -> None:
    with world.mcu.stuck_encoder(0):
        world.hold(0.5, seconds=3.0)


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    "happen",
    [happen_stop, happen_fault]
    + [pytest.param(other, marks=pytest.mark.slow) for other in (happen_loss, happen_silence)],
)
def test_the_minute_before_and_after_an_incident_is_retained(
    happen: Callable[[World], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minute = 6  # one tenth of a minute in s, to save time
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", minute * 10**9 // 3)
    monkeypatch.setattr(retention, "INCIDENT_MARGIN_NS", minute * 10**9)
    bench = Bench(tmp_path, monkeypatch)

    def rest(seconds: float) -> None:
        for _ in range(round(seconds * 2)):
            bench.world.run(0.5)
            bench.write()

    bench.world.drive(0.5, seconds=1.0)
    rest(14.0)
    began_s = bench.world.now_ns / 1e9
    happen(bench.world)
    ended_s = bench.world.now_ns / 1e9
    rest(14.0)
    paths = bench.end()
    flags = [not path.name.endswith("Z.mcap") for path in paths]
    began = [Recording(path).about.mono_ns / 1e9 for path in paths]
    spans = list(zip(began, [*began[1:], bench.world.now_ns / 1e9], strict=True))
    close = [s < began_s + minute - 0.5 and e > ended_s - minute + 0.5 for s, e in spans]
    near = [s < ended_s + minute + 2 and e > began_s - minute - 2 for s, e in spans]
    assert 2 <= sum(close) <= sum(near) <= len(paths) - 2, (close, near)
    for has, must, may in zip(flags, close, near, strict=True):
        assert must <= has <= may


def die(bench: Bench) -> None:
    """Close the open files and do nothing else, as the kernel does for a killed process."""
    side = bench.recorder._writer
    assert side._writing is not None
    assert side._directory is not None
    side._writing.close()
    side._directory.close()


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [5.0, 300.0])
def test_the_minute_before_and_after_a_crash_is_retained(
    after_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 2_000_000_000)
    bench = Bench(tmp_path, monkeypatch)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(14.0)
    die(bench)
    cut_s = START.wall_ns / 1e9 - after_s
    *before, cut = listed(tmp_path)
    assert len(before) > 2
    for number, path in enumerate([cut, *reversed(before)]):
        os.utime(path, (0, cut_s - 40.0 * number))  # as if each had lasted for 40 s
    again = Bench(tmp_path, monkeypatch)
    again.world.run(1.0)
    again.write()
    flags = [not path.name.endswith("Z.mcap") for path in again.end()]
    assert flags == [False] * (len(before) - 1) + [True, True, after_s < 60]


@pytest.mark.parametrize("fault_before", [True, False])
@pytest.mark.parametrize(
    ("after_s", "near"),
    [(20.0, True)] + [pytest.param(s, False, marks=pytest.mark.slow) for s in (70.0, -20.0)],
)
def test_the_minute_around_an_incident_is_retained_over_a_restart(
    after_s: float,
    near: bool,
    fault_before: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An orderly restart follows a fault, or a fault follows an orderly restart."""
    before = Bench(tmp_path, monkeypatch)
    before.world.drive(0.5, 0.2, seconds=1.0)
    if fault_before:
        before.world.call("stop")
    (ended,) = before.end()
    ended_s = START.wall_ns / 1e9 - after_s
    os.utime(ended, (0, ended_s))
    again = Bench(tmp_path, monkeypatch)
    again.world.drive(0.5, 0.2, seconds=0.5)
    if not fault_before:
        again.world.call("stop")
    again.write()
    other = "near" if near else ""
    kinds = ["kept", other] if fault_before else [other, "kept"]
    assert [name.partition("Z.")[2] for name in map(str, again.end())] == [
        f"{kind}.mcap".lstrip(".") for kind in kinds
    ]


BUG = "a fault of our own"


def ends_by(bench: Bench, error: Exception) -> list[Path]:
    """Close the recorder as the daemon does after this error in a task, and return the files."""
    bench.recorder.close(ExceptionGroup("unhandled errors in a TaskGroup", [error]))
    return listed(bench.where)


def break_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the robot raise an error when the next request arrives."""
    whole = Robot.hear

    def hear(robot: Robot, now: Instant, heard: Heard) -> News:
        if heard.requests:
            raise ZeroDivisionError(BUG)
        return whole(robot, now, heard)

    monkeypatch.setattr(Robot, "hear", hear)


@pytest.mark.slow
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
        (path,) = ends_by(bench, raised.value)
        ended = replay_file(Recording(path)).failed_step
    last, number = read_end(path), bench.world.steps
    why = f"in step {number}, ZeroDivisionError: {BUG}"
    assert path.name.endswith(KEPT_SUFFIX)
    assert last is not None
    assert (last.cut, last.why) == ("bug", why)
    assert ending_text(last.cut, last.why) == f"an internal error ended the daemon: {why}"
    recording = Recording(path)
    result = replay_file(recording)
    assert (result.comparison.same, result.comparison.steps, result.gaps) == (True, number, [])
    assert (recording.is_intact, recording.cut, recording.why) == (True, "bug", why)
    assert recording.unfinished is not None
    step = unfinished(recording.unfinished)
    assert step.number == number
    # The bus delivers a called stop as an arrival and as a query.
    assert [request.verb for request in step.inputs.requests] == ["stop", "stop"]
    assert step.inputs.now.mono_ns <= bench.world.now_ns
    assert "does not fail in this version" in result.failed_step
    assert ("also fails in this version of acsard, with ZeroDivision" in ended) is (
        broken == "robot"
    )
    rewrite(recording, new := path.with_name("new.mcap"))
    assert read_end(new) == last
    assert replay_file(Recording(new)) == result


def test_the_text_of_a_bug_is_shortened_and_printable(bench: Bench) -> None:
    bench.world.run(1.0)
    bench.write()
    (path,) = ends_by(bench, ValueError("\x1b[2J" + "x" * 1000))
    last = read_end(path)
    assert last is not None
    text = ending_text(last.cut, last.why)
    assert text.startswith("an internal error ended the daemon: ValueError: ")
    assert (text.isprintable(), len(text) < 300) == (True, True)


def test_a_bug_whose_text_cannot_be_produced_is_still_recorded(bench: Bench) -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise ValueError

    bench.world.run(1.0)
    (path,) = ends_by(bench, MuteError())
    last = read_end(path)
    assert last is not None
    assert (last.cut, last.why) == ("bug", "MuteError")


def test_an_internal_error_that_ends_the_recorder_is_logged_at_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    bench.world.run(1.0)
    tape = Tape()
    World(recorder=tape).run(0.1)
    step = tape.taken[0]
    bench.recorder._queue.append(step._replace(inputs=replace(step.inputs, missed=1 << 80)))
    bench.recorder._over.set()
    bench.recorder._thread.join(20.0)
    bench.world.run(0.1)
    assert bench.said[-1].text.startswith("the recorder has ended because of an internal error")
    assert "the recorder has ended" in bench.recorder.status.trouble


def test_inputs_that_cannot_be_encoded_are_left_out(bench: Bench) -> None:
    bench.world.run(1.0)
    tape = Tape()
    World(recorder=tape).run(0.1)
    bench.recorder.died(replace(tape.taken[0].inputs, missed=1 << 80))
    (path,) = ends_by(bench, OverflowError("a name that is none: \udc80"))
    last, recording = read_end(path), Recording(path)
    assert last is not None
    prefix = f"in step {bench.world.steps}, OverflowError: a name that is none: "
    assert (last.cut, last.why.startswith(prefix)) == ("bug", True)
    assert [topic for topic, _, _ in recording.messages()].count("unfinished") == 0
    assert (replay_file(recording).comparison.same, recording.is_intact) == (True, True)


@pytest.mark.parametrize("error", [None, asyncio.CancelledError()])
def test_a_requested_end_is_not_a_bug(error: BaseException | None, bench: Bench) -> None:
    bench.world.run(1.0)
    bench.recorder.close(error)
    assert cuts(listed(bench.where)) == [("mcap", "")]


def test_a_bug_in_the_first_step_is_recorded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.world.bus.arrivals.append(Arrival("stop", True, b"", "", bench.world.now_ns, None, ""))
    break_robot(monkeypatch)
    with pytest.raises(ZeroDivisionError) as raised:
        bench.world.run(1.0)
    (path,) = ends_by(bench, raised.value)
    recording = Recording(path)
    ((topic, _, data),) = recording.messages()
    assert (topic, unfinished(data).number, recording.cut) == ("unfinished", 0, "bug")
    last = read_end(path)
    assert last is not None
    assert last.said == "start"


@pytest.mark.slow
def test_the_minute_before_a_bug_is_retained(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 2_000_000_000)
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(6.0)
    endings = cuts(ends_by(bench, ValueError(BUG)))
    assert len(endings) > 2
    assert endings == [("near.mcap", "")] * (len(endings) - 1) + [("kept.mcap", "bug")]


@pytest.mark.slow
@pytest.mark.parametrize("jumps", [(20,), (20, -20), (-20,)])
def test_a_jump_of_the_clock_costs_no_recording(
    jumps: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot without a real-time clock was off for weeks.

    Its wall clock is set only while the robot drives.
    """
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 2_000_000_000)
    monkeypatch.setattr(retention, "INCIDENT_MARGIN_NS", 0)
    names = set[str]()

    def there() -> set[str]:
        return {path.name.partition(".")[0] for path in listed(tmp_path)}

    for _ in range(2):  # one run after another
        bench = Bench(tmp_path, monkeypatch)
        bench.world.drive(0.5, 0.2, seconds=1.0)
        for days in (0, *jumps):
            bench.world.wall_offset_ns += days * 86_400 * 10**9
            bench.drive(6.0)
            names |= there()
        bench.end()
    assert len(names) > 6
    assert names <= there()


@pytest.mark.slow
def test_a_file_that_the_disk_cut_keeps_its_retention_class(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    bench.world.call("stop")
    bench.world.run(1.0)
    bench.write()
    bench.recorder._writer._fail(OSError(errno.ENOSPC, "No space left on device"))
    bench.drive(step_writer.RETRY_ROUNDS + 3.0)
    first, second = bench.end()
    assert first.name.endswith(KEPT_SUFFIX)
    last = read_end(first)
    assert last is not None
    assert last.cut == "disk"
    assert replay_file(Recording(second)).comparison.same


def no_copies(handle: int) -> None:
    """Make each sync of a recovered copy fail."""
    if os.readlink(f"/proc/self/fd/{handle}").endswith(".new"):
        raise OSError(errno.EIO, os.strerror(errno.EIO))


def full(handle: int) -> None:
    """Fail like a sync on a disk without free space."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def eager(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a bench that drives and retries a failed disk in the next round."""
    monkeypatch.setattr(step_writer, "RETRY_ROUNDS", 0)
    bench.world.drive(0.5, 0.2, seconds=0.5)
    rounds(bench)
    return bench


def rounds(bench: Bench, count: int = 3) -> None:
    """Run short rounds of the recorder.

    After an error the first round retries the disk, and the second round starts a file.
    """
    for _ in range(count):
        bench.world.hold(0.5, 0.2, seconds=0.1)
        bench.write()


def refuse(bench: Bench) -> None:
    """Let the disk refuse a write, and then let the retry succeed."""
    bench.recorder._writer._fail(OSError(errno.EIO, os.strerror(errno.EIO)))
    rounds(bench)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Limit the size of files in bytes; writes beyond it fail as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("happened", "error", "ending"),
    [
        (False, None, ("mcap", "late")),
        (True, None, ("kept.mcap", "late")),
        (False, ValueError(BUG), ("kept.mcap", "crash")),
    ],
)
def test_an_end_that_the_disk_was_too_slow_for_counts_as_a_crash_only_after_a_crash(
    happened: bool,
    error: Exception | None,
    ending: tuple[str, str],
    eager: Bench,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if happened:
        eager.world.call("stop")
        rounds(eager)
    goes, sync = threading.Event(), os.fsync
    synced = listed(eager.where)[0].stat().st_size

    def hangs(handle: int) -> None:
        goes.wait(20.0)
        sync(handle)

    monkeypatch.setattr(module, "CLOSE_S", 0.01)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", hangs)
        eager.recorder.close(error)
        # This is the state of the disk after the process has ended.
        shutil.copytree(eager.where, where := tmp_path_factory.mktemp("again") / "record")
    goes.set()
    eager.recorder._thread.join(20.0)
    (part,) = listed(where)
    part.write_bytes(part.read_bytes()[:synced])
    again = Bench(where, monkeypatch)
    rounds(again)
    assert cuts(again.end()) == [ending, ("mcap", "")]
    assert not list(where.glob(".0*"))


def numbers_of(paths: list[Path]) -> list[int]:
    return [step.number for path in paths for step in steps(Recording(path))]


def test_steps_that_the_disk_refused_are_counted_exactly(eager: Bench) -> None:
    (part,) = listed(eager.where)
    with files_of_at_most(part.stat().st_size + 20):
        rounds(eager, 1)
    assert eager.recorder.status.trouble.endswith("File too large")
    rounds(eager)
    missing = eager.recorder.status.missing
    numbers = numbers_of(eager.end())
    assert numbers == sorted(set(numbers))
    gap = max(b - a - 1 for a, b in pairwise(numbers))
    assert missing == gap == eager.world.steps - len(numbers) > 10


@pytest.mark.parametrize("over", [False, True])
def test_steps_that_the_disk_did_not_sync_are_counted_exactly(
    over: bool, eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sync of a chunk fails, or the sync at the end of a file."""
    (part,) = listed(eager.where)
    synced = part.stat().st_size
    if over:
        eager.recorder._request_state()
    with monkeypatch.context() as patched:
        # The file is long enough to end.
        patched.setattr(step_writer, "MAX_FILE_NS", 0)
        patched.setattr(os, "fsync", full)
        rounds(eager, 1)
    part.write_bytes(part.read_bytes()[:synced])  # data that was not synced never reached the disk
    rounds(eager)
    missing = eager.recorder.status.missing
    numbers = numbers_of(eager.end())
    assert missing == eager.world.steps - len(numbers) > 10


def cuts(paths: list[Path]) -> list[tuple[str, str]]:
    """Return the suffix of each file and the reason why it was finished late."""
    return [(p.name.partition(".")[2], last.cut) for p in paths if (last := read_end(p))]


def test_a_file_that_a_crash_cut_keeps_this_cause_however_late_it_is_finished(
    eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    die(eager)
    again = Bench(eager.where, monkeypatch)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", no_copies)
        rounds(again)
    refuse(again)
    assert any("cannot be completed" in event.text for event in again.said)
    assert cuts(again.end()) == [("kept.mcap", "crash"), ("mcap", "disk"), ("mcap", "")]


def test_each_file_that_the_disk_cut_keeps_its_class_and_cause(
    eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    eager.world.call("stop")
    rounds(eager)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", no_copies)
        refuse(eager)
    refuse(eager)
    endings = [("kept.mcap", "disk"), ("near.mcap", "disk"), ("near.mcap", "")]
    assert cuts(eager.end()) == endings


def test_a_file_whose_end_the_disk_refuses_has_the_cause_disk(
    eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    eager.recorder._request_state()
    with monkeypatch.context() as patched:
        # The file is long enough to end.
        patched.setattr(step_writer, "MAX_FILE_NS", 0)
        patched.setattr(os, "fsync", full)
        rounds(eager, 1)
    assert eager.recorder.status.trouble.endswith("No space left on device")
    (part,) = listed(eager.where)
    part.write_bytes(part.read_bytes()[:-40])  # data that was not synced never reached the disk
    rounds(eager)
    assert cuts(eager.end()) == [("mcap", "disk"), ("mcap", "")]


@pytest.mark.parametrize(
    ("happened", "error", "ending"),
    [
        (False, None, ("mcap", "disk")),
        (True, None, ("kept.mcap", "disk")),
        (False, ValueError(BUG), ("kept.mcap", "crash")),
    ],
)
def test_a_disk_that_refuses_the_end_does_not_look_like_a_crash_to_the_next_daemon(
    happened: bool,
    error: Exception | None,
    ending: tuple[str, str],
    eager: Bench,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if happened:
        eager.world.call("stop")
        rounds(eager)
    (part,) = listed(eager.where)
    synced = part.stat().st_size
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        eager.recorder.close(error)
    part.write_bytes(part.read_bytes()[:synced])
    again = Bench(eager.where, monkeypatch)
    rounds(again)
    assert cuts(again.end())[0] == ending
    assert not list(eager.where.glob(".0*"))


def test_a_disk_that_hangs_delays_the_end_of_the_daemon_only_briefly(
    eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes = threading.Event()

    def hangs(*_: object) -> None:
        goes.wait(60.0)

    monkeypatch.setattr(module, "CLOSE_S", 0.01)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", hangs)
        patched.setattr(step_writer, "mark_cut", hangs)
        eager.recorder.close()
        assert eager.recorder._thread.is_alive()
    goes.set()
    eager.recorder._thread.join(20.0)


@pytest.mark.slow
def test_protected_files_are_not_all_deleted_for_a_disk_that_keeps_refusing(
    eager: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example, the disk has no free inodes, and another program takes each freed inode."""
    die(eager)
    ring = RecordingDirectory(config(eager.where).record)
    before = [
        ring.end(ring.begin(About("acsar", "0.1.0", "3.11.0", 1, number)), "kept")
        for number in range(4)
    ]
    ring.close()
    again = Bench(eager.where, monkeypatch)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        rounds(again, 10)
    assert again.recorder.status.trouble.endswith("No space left on device")
    assert all(path.exists() for path in before), "the oldest, of the crash, was worth a try"
    rounds(again)
    assert again.recorder.status.trouble == ""
    assert len(again.end()) == 5


@pytest.mark.slow
def test_a_file_that_cannot_be_finished_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "000001-20270115T080000Z.mcap.part"
    RecordingWriter(path, About("acsar", "9.0", "3.13", 1, 2, format="later")).close()
    bench = Bench(tmp_path, monkeypatch)
    bench.world.run(1.0)
    bench.write()
    bench.world.run(1.0)
    assert ("warning", True) in [
        (event.level, path.name[:24] in event.text) for event in bench.said
    ]
    assert len(bench.end()) == 2


@pytest.mark.slow
def test_a_directory_that_was_removed_is_reported_and_created_again(bench: Bench) -> None:
    bench.world.drive(0.5, 0.2, seconds=1.0)
    bench.drive(2.0)
    shutil.rmtree(bench.where)
    bench.drive(1.0)
    assert "has been removed" in bench.recorder.status.trouble
    bench.drive(step_writer.RETRY_ROUNDS + 3.0)
    status = bench.recorder.status
    assert status.trouble == ""
    assert status.missing > 0
    (path,) = bench.end()
    result = replay_file(Recording(path))
    assert (result.comparison.same, result.gaps) == (True, [])


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
    monkeypatch.setattr(module, "SYNC_PAUSE_S", 0.01)
    monkeypatch.setattr(module, "CLOSE_S", 20.0)
    tape, world = recorded_world()
    world.drive(0.5, seconds=0.5)
    step = tape.taken[-1]
    recorder = Recorder(config(tmp_path), lambda event: None)
    recorder.step(*step, world.loop.robot, world.loop._guard)
    assert asked.wait(20.0)
    before = len(recorder._queue)
    for _ in range(1000):
        recorder.step(*step, world.loop.robot, world.loop._guard)
    hung = not goes.is_set()
    assert (len(recorder._queue) - before, thread_names, hung) == (1000, {"record"}, True)
    assert recorder._queue[-1][0] is step.inputs
    goes.set()
    recorder.close()
    assert len(numbers_of(listed(tmp_path))) == 1001


def test_recordings_and_exports_name_the_paths_of_keys_and_contain_no_secret(
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
    recording = Recording(path)
    contents = [path.read_bytes(), recording.about.config.encode()]
    contents += [data for _, _, data in recording.messages()]
    assert not [data for data in contents if SECRET.encode() in data]
    assert str(certificates) in recording.about.config
