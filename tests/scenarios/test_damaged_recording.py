"""A replay and an export continue after damage in a recording, and report the lost steps."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.cli import main
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import NS_PER_S
from acsard.host.errors import Exit
from acsard.recording import mcap_recorder as module
from acsard.recording import step_writer
from acsard.recording.file_replay import EventCopies, RecordedRun, replay_file, steps
from acsard.recording.mcap_directory import listed
from acsard.recording.mcap_file import (
    CHANNEL_NUMBERS,
    Recording,
    RecordingWriter,
    event_of,
    rewrite,
)
from acsard.recording.mcap_recorder import Recorder
from acsard.recording.mcap_records import walk
from acsard.recording.series import Series
from tests.each import each
from tests.scenarios.taped import chunks, recorded_world
from tests.scenarios.world import World

pytestmark = pytest.mark.slow

MINUTES = 10

SHARE = 0.95
"""Least share of the file that is replayed in spite of one damaged place."""

RATE = 10.0
"""Control rate, Hz. With the default rate the recording and each replay would take 12 s each."""

DAMAGED_BYTES = (1, 512, 4096)
"""Sizes of the damaged places: a byte, a sector and a page."""


def record(where: Path, seconds: int) -> list[Path]:
    """Drive in virtual time and record with the real recorder; return the recordings."""
    dice = random.Random(1)
    config = replace(
        Config(),
        control=replace(Config().control, rate=RATE),
        record=RecordConfig(str(where), 1000.0),
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "SYNC_PAUSE_S", 1000.0)
        patched.setattr(module, "CLOSE_S", 20.0)
        recorder = Recorder(config, lambda event: None)
        world = World(config, recorder=recorder)
        world.drive(0.5, 0.2, seconds=1.0)
        for second in range(seconds):
            if second % 100 == 50:
                settings = b'{"settings": {"limits.linear_speed": %.1f}}' % dice.uniform(0.5, 0.9)
                assert world.call("set", settings).success
            speed = 0.0 if second % 30 < 5 else dice.uniform(-0.8, 0.8)
            world.hold(speed, dice.uniform(-1.0, 1.0), seconds=1.0)
            recorder._writer.write(recorder._take_queue(), False)
        recorder.close()
    return listed(where)


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 10 minutes."""
    (path,) = record(tmp_path_factory.mktemp("record"), 60 * MINUTES)
    return path


def harmed(path: Path, new: Path, place: int, length: int) -> Path:
    data = bytearray(path.read_bytes())
    for at in range(place, min(place + length, len(data))):
        data[at] ^= 0xA5
    new.write_bytes(data)
    return new


def places(path: Path, count: int, seed: int = 1) -> list[tuple[int, int]]:
    """Return random positions in the file, and the number of bytes to damage at each one.

    The positions avoid the stored robot states, because damage there loses no step.
    """
    dice, data = random.Random(seed), path.read_bytes()
    states = [range(*span) for span in spans_of_states(data)]
    every = [at for at in range(len(data)) if not any(at in span for span in states)]
    return [(dice.choice(every), dice.choice(DAMAGED_BYTES)) for _ in range(count)]


def spans_of_states(data: bytes) -> list[tuple[int, int]]:
    """Return the start and end position of each chunk that contains a robot state."""
    parts = [place.chunk for place in walk(data) if place.chunk is not None]
    state = CHANNEL_NUMBERS["state"]
    return [(c.begin, c.end) for c in parts if [m.channel for m in c.messages] == [state]]


def judge(path: Path, new: Path, place: int, length: int) -> float:
    """Replay a copy with `length` damaged bytes at `place`, and check the reported gaps.

    Returns the share of the steps that the replay could still compare.
    """
    whole = sum(1 for _ in steps(Recording(path)))
    recording = Recording(harmed(path, new, place, length))
    result = replay_file(recording)
    assert result.same, (place, length, result.comparison.first, result.event_copies)
    assert result.comparison.exact
    count = result.comparison.steps
    assert bool(result.gaps) == (count < whole)
    lost = sum(gap.unreadable + gap.skipped for gap in result.gaps)
    assert lost == whole - count or any(gap.end_lost for gap in result.gaps)
    return count / whole


def test_the_whole_recording_is_replayed(long: Path) -> None:
    result = replay_file(Recording(long))
    assert (result.same, result.comparison.exact, result.gaps) == (True, True, [])
    states = [1 for topic, _, _ in Recording(long).messages() if topic == "state"]
    assert len(states) >= 3 * MINUTES - 1


@each("number", range(2))
def test_damage_costs_at_most_a_twentieth_of_ten_minutes(
    number: int, long: Path, tmp_path: Path
) -> None:
    place, length = places(long, 20)[number]
    assert SHARE <= judge(long, tmp_path / "harmed.mcap", place, length) < 1.0


def test_damage_to_a_state_of_the_robot_costs_no_step(long: Path, tmp_path: Path) -> None:
    begin, end = spans_of_states(long.read_bytes())[7]
    recording = Recording(harmed(long, tmp_path / "harmed.mcap", begin, end - begin))
    run = RecordedRun(recording)
    numbers = [step.number for step in run.steps()]
    assert numbers == [step.number for step in steps(Recording(long))]
    assert (run.gaps, recording.damaged) == ([], 1)


def test_damage_at_the_beginning_of_a_file_costs_nothing(long: Path, tmp_path: Path) -> None:
    """Damage one byte of the magic bytes, the metadata or the configuration. No step is lost."""
    data = long.read_bytes()
    whole = [step.number for step in steps(Recording(long))]
    for word in (b"MCAP0", b"acsar", b"mono_ns", b"[limits]", b"wheel_radius = 0.0"):
        new = harmed(long, tmp_path / "harmed.mcap", data.index(word) + len(word), 1)
        recording = Recording(new)
        assert recording.about == Recording(long).about, word
        assert [step.number for step in RecordedRun(recording).steps()] == whole, word
        Recording(harmed(long, new, 0, data.index(b"[limits]")))


@pytest.mark.soak
def test_damage_at_twenty_random_places_costs_at_most_a_twentieth_each(
    long: Path, tmp_path: Path
) -> None:
    shares = [judge(long, tmp_path / "harmed.mcap", *place) for place in places(long, 20)]
    print(f"least share {min(shares):.4f}, mean {sum(shares) / len(shares):.4f}")
    assert min(shares) >= SHARE


def test_replay_and_export_exit_with_their_own_code_and_name_the_missing_part(
    long: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin, end = chunks(long.read_bytes())[22]
    new = str(harmed(long, tmp_path / "harmed.mcap", (begin + end) // 2, 1))
    assert main(["recording", "replay", new]) == Exit.INCOMPLETE
    out, err = capsys.readouterr()
    assert "lines are the same" in out
    assert "not compared: " in err
    assert "s in 1 damaged place (" in err
    assert "cannot be read" in err
    assert main(["recording", "export", new, str(tmp_path / "a.csv"), "--csv"]) == Exit.INCOMPLETE
    assert "not exported: " in capsys.readouterr().err
    last = float((tmp_path / "a.csv").read_text().splitlines()[-1].partition(",")[0])
    first = float((tmp_path / "a.csv").read_text().splitlines()[1].partition(",")[0])
    assert last - first > 60 * MINUTES - 5
    before = ["recording", "export", new, str(tmp_path / "b.csv"), "--csv", "--to", "60"]
    assert main(before) == Exit.OK, "no step of that time is missing"
    assert "not exported" not in capsys.readouterr().err


def test_another_configuration_stays_in_force_after_a_damaged_section(
    long: Path, tmp_path: Path
) -> None:
    """A replay with another limit still uses this limit after the damaged section.

    It also still uses the limits that the operator changed during the recording.
    """
    begin, end = chunks(long.read_bytes())[22]
    recording = Recording(harmed(long, tmp_path / "harmed.mcap", (begin + end) // 2, 1))
    other = replace(Config(), limits=replace(Config().limits, angular_speed=0.3))
    run, limits = RecordedRun(recording, other), set()
    plain = RecordedRun(recording)
    for _ in run.steps():
        if run.gaps:
            limits.add(run.robot.config.limits)
    for _ in plain.steps():
        pass
    assert run.gaps == plain.gaps
    (limit,) = limits
    assert limit.angular_speed == 0.3
    assert limit.linear_speed == plain.robot.config.limits.linear_speed != 1.0


def test_damage_that_hides_the_end_of_a_file_is_not_reported_as_a_truncation(
    long: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The damage covers the header of the last chunk, with its length, and half of its content.

    The replay reports that it cannot find the end of the recording.
    """
    begin, end = chunks(long.read_bytes())[-1]
    new = harmed(long, tmp_path / "harmed.mcap", begin, (end - begin) // 2)
    recording = Recording(new)
    result = replay_file(recording)
    assert (result.same, recording.ended, recording.damaged, recording.cut) == (True, True, 1, "")
    (gap,) = result.gaps
    assert gap.end_lost
    assert 0.0 < (gap.end_ns - gap.begin_ns) / 1e9 < 11.0
    assert main(["recording", "replay", str(new)]) == Exit.INCOMPLETE
    assert (
        "the end of the recording, which may contain more steps, cannot" in capsys.readouterr().err
    )


def test_a_lost_chunk_whose_events_begin_the_next_one_is_not_reported_as_a_forgery(
    tmp_path: Path,
) -> None:
    tape, world = recorded_world()
    world.drive(0.5, seconds=3.0)
    world.call("stop")
    world.run(3.0)
    path = tmp_path / "a.mcap"
    tape.write(path, Config())
    recording = Recording(path)
    messages = [*recording.messages()]
    batches = [number for number, (topic, _, _) in enumerate(messages) if topic == "steps"]
    stop = next(
        n for n, (topic, _, data) in enumerate(messages) if topic == "events" and b"stop" in data
    )
    lost = max(number for number in batches if number < stop)
    writing = RecordingWriter(tmp_path / "b.mcap", recording.about)
    for number, (topic, wall_ns, data) in enumerate(messages):
        if topic == "events":
            writing.event(event_of(recording, data))
        else:
            writing.add(topic, wall_ns, data)
        writing.flush()
        if number in (lost - 1, lost):
            writing.end_chunk()
    writing.finish()
    assert replay_file(Recording(tmp_path / "b.mcap")).same
    begin, end = chunks((tmp_path / "b.mcap").read_bytes())[1]
    new = harmed(tmp_path / "b.mcap", tmp_path / "c.mcap", begin, end - begin)
    result = replay_file(Recording(new))
    assert (result.event_copies, len(result.gaps)) == ("", 1)


def test_a_series_goes_on_with_the_state_at_the_beginning_of_its_next_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_writer, "MAX_FILE_NS", 30 * NS_PER_S)
    first, second = record(tmp_path / "record", 45)
    begin, end = chunks(first.read_bytes())[-1]
    new = harmed(first, tmp_path / "harmed.mcap", begin, (end - begin) // 2)
    new.rename(first)
    run = RecordedRun(Series([first, second]))
    numbers = [step.number for step in run.steps()]
    (gap,) = run.gaps
    assert (gap.unreadable > 0, gap.skipped, gap.end_lost) == (True, 0, False)
    assert numbers[-1] == max(step.number for step in steps(Recording(second)))


def test_a_recovered_copy_of_a_damaged_recording_is_replayed_up_to_the_same_gap(
    long: Path, tmp_path: Path
) -> None:
    """The copy contains no damage, but the lost steps are still missing."""
    begin, end = chunks(long.read_bytes())[22]
    recording = Recording(harmed(long, tmp_path / "harmed.mcap", (begin + end) // 2, 1))
    rewrite(recording, tmp_path / "copy.mcap")
    copied, original = Recording(tmp_path / "copy.mcap"), RecordedRun(recording)
    copy = RecordedRun(copied, copies=(copies := EventCopies(copied)))
    assert [s.number for s in copy.steps()] == [s.number for s in original.steps()]
    assert copy.gaps == original.gaps != []
    copies.end()
    assert copies.difference == ""
