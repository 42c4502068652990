"""The recorder writes what a replay needs: heads, files, settings, and the step that failed."""

from __future__ import annotations

import asyncio
import stat
import threading
from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.link.serial_output import Offered
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Heard, Instant, Latches, News
from acsard.recording import recorder as module
from acsard.recording.file import Failure, Head, Recording, Waits, listed
from acsard.recording.recorder import Recorder
from acsard.recording.replay import Playback
from tests.scenarios.world import START, World
from tests.unit.drives import drive

SECRET = "PRIVATE KEY of a robot"
BUG = "a part that is never zero"


class Bench:
    """A world that drives, and whose recorder writes only when the test calls `write`."""

    def __init__(self, config: Config, latches: Latches) -> None:
        self.said: list[Event] = []
        self.where = Path(config.record.directory)
        self.recorder = Recorder(config, self.said.append)
        self.world = World(config, recorder=self.recorder, latches=latches)

    def write(self) -> None:
        """Do the work that the recorder's thread does once a second."""
        self.recorder._writer.write(self.recorder._take_queue(), False)

    def drive(self, seconds: int) -> None:
        """Continue the drive for this time, and let the recorder write after each second."""
        for _ in range(seconds):
            self.world.hold(0.5, 0.2, seconds=1.0)
            self.write()

    def end(self, error: BaseException | None = None) -> list[Path]:
        self.recorder.close(error)
        return listed(self.where)


@pytest.fixture
def new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a bench before its first step."""
    monkeypatch.setattr(module, "WRITE_PAUSE_S", 1000.0)
    monkeypatch.setattr(module, "CLOSE_S", 20.0)
    config = replace(Config(), record=RecordConfig(str(tmp_path), 10.0))
    return Bench(config, Latches((), 5))


@pytest.fixture
def bench(new: Bench) -> Bench:
    new.world.drive(0.5, 0.2, seconds=1.0)
    return new


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


def heads_of(paths: list[Path]) -> list[Head]:
    return [record for record in Recording(paths).records() if isinstance(record, Head)]


def test_heads_and_files_begin_after_their_times_and_each_file_replays_alone(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Path(__file__).parents[2] / "deploy/manual/pages/reference/recordings.md"
    assert "ends after an hour" in page.read_text(encoding="utf-8")
    assert module.FILE_NS == 3600 * NS_PER_S
    for name, seconds in (("HEAD_NS", 2), ("SYNC_NS", 1), ("FILE_NS", 5)):
        monkeypatch.setattr(module, name, seconds * NS_PER_S)
    bench.recorder._head_ns -= 18 * NS_PER_S
    bench.drive(8)
    paths = bench.end()
    assert len(paths) == 2
    heads = [head.mono_ns for head in heads_of(paths)]
    assert max(b - a for a, b in pairwise(heads)) <= 2.02 * NS_PER_S
    assert len(heads) == 6  # every 2 s, and for the second file
    assert sum(played([path]).comparison.steps for path in paths) == bench.world.steps
    assert played(paths).gaps == []


def test_a_changed_setting_is_in_the_next_head_after_20_s(bench: Bench) -> None:
    assert bench.world.call("set", b'{"settings": {"limits.linear_speed": 0.25}}').success
    bench.drive(20)
    first, second = heads_of(bench.end())
    assert second.mono_ns - first.mono_ns == pytest.approx(20 * NS_PER_S, abs=0.02 * NS_PER_S)
    assert "linear_speed = 0.25" in second.config
    assert "linear_speed = 0.25" not in first.config


@pytest.mark.parametrize("hours", [1, -1])
def test_a_set_clock_begins_a_new_file_which_is_found_by_its_time(hours: int, bench: Bench) -> None:
    bench.drive(2)
    bench.world.wall_offset_ns += hours * 3600 * NS_PER_S
    bench.drive(3)
    paths = bench.end()
    assert len(paths) == 2
    assert played(paths).gaps == []
    first, second = heads_of(paths)
    at_ns = START.wall_ns + hours * 3600 * NS_PER_S
    found = list(Recording(paths, at_ns, at_ns + 60 * NS_PER_S).steps())
    assert {step.number for step in found} >= set(range(second.number, bench.world.steps))
    found = list(Recording(paths, START.wall_ns, START.wall_ns + 2 * NS_PER_S).steps())
    assert found[0].number == first.number


def test_what_sources_wait_for_is_recorded_as_soon_as_the_queue_has_room(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_QUEUED_STEPS", 1000)
    while bench.recorder.status.missing == 0:
        bench.world.hold(0.5, 0.2, seconds=1.0)
    waits = {"teleop": Reason("higher", "app has priority")}
    monkeypatch.setattr(Robot, "waits", lambda *_: waits)
    bench.world.hold(0.5, 0.2, seconds=2.0)
    bench.drive(3)
    lost = bench.recorder.status.missing
    paths = bench.end()
    (recorded,) = [record for record in Recording(paths).records() if isinstance(record, Waits)]
    assert recorded.reasons == {"teleop": ("higher", "app has priority")}
    playback = played(paths)
    assert playback.comparison.steps == bench.world.steps - lost
    assert [gap.steps for gap in playback.gaps] == [lost]


# the step in which the daemon fails


def break_robot(patched: pytest.MonkeyPatch) -> None:
    """Let each step with a request fail."""
    hear = Robot.hear

    def broken(robot: Robot, now: Instant, heard: Heard) -> News:
        if heard.requests:
            raise ZeroDivisionError(BUG)
        return hear(robot, now, heard)

    patched.setattr(Robot, "hear", broken)


def break_port(bench: Bench, patched: pytest.MonkeyPatch) -> None:
    def offer(line: bytes, now: Instant) -> Offered:
        raise ZeroDivisionError(BUG)

    patched.setattr(bench.world.port, "offer", offer)


def failure_of(paths: list[Path]) -> Failure:
    *_, last = Recording(paths).records()
    assert isinstance(last, Failure)
    return last


@pytest.mark.parametrize("broken", ["robot", "port"])
def test_a_bug_of_the_daemon_is_recorded_with_the_inputs_of_the_failed_step(
    broken: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        if broken == "robot":
            break_robot(patched)
        else:
            break_port(bench, patched)
        with pytest.raises(ZeroDivisionError) as raised:
            bench.world.call("stop")
        paths = bench.end(ExceptionGroup("of a task", [raised.value]))
        here = played(paths).failed_step()
    failure = failure_of(paths)
    assert (failure.number, failure.why) == (bench.world.steps, f"ZeroDivisionError: {BUG}")
    assert failure.heard is not None
    # The bus delivers a called stop as an arrival and as a query.
    assert [request.verb for request in failure.heard.requests] == ["stop", "stop"]
    playback = played(paths)
    assert playback.comparison.steps == failure.number
    assert "does not fail in this version" in playback.failed_step()
    assert ("also fails here, with ZeroDivision" in here) is (broken == "robot")


def test_a_bug_in_the_first_step_is_recorded(new: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    new.world.bus.arrivals.append(Arrival("stop", True, b"", "", new.world.now_ns, None, ""))
    break_robot(monkeypatch)
    with pytest.raises(ZeroDivisionError) as raised:
        new.world.run(1.0)
    assert failure_of(new.end(raised.value)).number == 0


def test_a_failed_step_that_cannot_be_written_down_costs_its_inputs_only(bench: Bench) -> None:
    step = drive().taken[0]
    bench.recorder.died(step.now, replace(step.heard, missed=1 << 80))
    paths = bench.end(ZeroDivisionError(BUG))
    assert failure_of(paths) == Failure(bench.world.steps, f"ZeroDivisionError: {BUG}")


class MuteError(Exception):
    def __str__(self) -> str:
        raise ValueError


def test_a_bug_whose_text_cannot_be_produced_is_still_recorded_and_a_requested_end_is_none(
    bench: Bench,
) -> None:
    paths = bench.end(asyncio.CancelledError())
    assert played(paths).failure is None
    new = Bench(replace(Config(), record=RecordConfig(str(bench.where / "new"), 10.0)), Latches())
    new.world.run(0.1)
    assert failure_of(new.end(MuteError())) == Failure(new.world.steps, "MuteError")


def test_an_internal_error_that_ends_the_recorder_is_logged_at_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    step = drive().taken[0]
    bench.recorder._queue.append(step._replace(heard=replace(step.heard, missed=1 << 80)))
    bench.recorder._over.set()
    bench.recorder._thread.join(20.0)
    bench.world.run(0.1)
    assert bench.said[-1].text.startswith("the recorder has ended because of an internal error")
    assert "the recorder has ended" in bench.recorder.status.trouble


def test_recordings_name_the_paths_of_keys_and_contain_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificates, where = tmp_path / "tls", tmp_path / "record"
    certificates.mkdir()
    for name in ("ca.pem", "robot.pem", "robot-key.pem"):
        (certificates / name).write_text(f"-----BEGIN {SECRET} {name}-----")
    listen = ("tcp/127.0.0.1:7448", "tls/0.0.0.0:7449")
    bus = replace(Config().bus, tls=str(certificates), listen=listen)
    config = replace(Config(), record=RecordConfig(str(where), 10.0), bus=bus)
    monkeypatch.setattr(module, "CLOSE_S", 20.0)
    monkeypatch.setenv("ACSARD_SECRET", SECRET)
    recorder = Recorder(config, lambda event: None)
    world = World(config, recorder=recorder)
    world.put("cmd/app", f'{{"password": "{SECRET}"}}'.encode())
    world.drive(0.3, 0.0, 0.5)
    recorder.close()
    (path,) = listed(where)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    records = list(Recording([path]).records())
    assert len(records) > 100
    assert SECRET not in repr(records)
    assert str(certificates) in heads_of([path])[0].config
