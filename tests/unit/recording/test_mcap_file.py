"""Every complete chunk of a damaged recording can be read, and no damage causes a traceback."""

from __future__ import annotations

import os
import random
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.values import NS_PER_S, Instant
from acsard.host.errors import RecordingError
from acsard.recording.end_record import EndRecord, read_end
from acsard.recording.file_replay import config_of, replay_file, steps
from acsard.recording.mcap_file import (
    CHUNK_BYTES,
    FILE_MODE,
    HOW_TO_READ,
    About,
    Recording,
    RecordingWriter,
    rewrite,
)
from acsard.recording.recorded_steps import status_of
from acsard.recording.rows import encode
from tests.scenarios.taped import BATCH, Tape, chunks, recorded_world
from tests.scenarios.world import World


@pytest.fixture(scope="module")
def tape() -> Tape:
    tape, world = recorded_world()
    world.drive(0.5, 0.2, seconds=6.0)
    world.call("stop")
    return tape


@pytest.fixture(scope="module")
def whole(tape: Tape, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("record") / "whole.mcap"
    tape.write(path, Config())
    return path


def numbers(path: Path) -> list[int]:
    return [step.number for step in steps(Recording(path))]


@pytest.mark.slow
def test_all_recorded_data_is_read_back(tape: Tape, whole: Path) -> None:
    recording = Recording(whole)
    read = list(steps(recording))
    assert [step.inputs for step in read] == [entry.inputs for entry in tape.taken]
    assert [step.recorded.status for step in read] == [status_of(t.outputs) for t in tape.taken]
    assert (recording.is_intact, recording.damaged) == (True, 0)
    assert config_of(recording) == Config()
    assert replay_file(recording).comparison.same


def test_the_mcap_library_reads_a_recording(tape: Tape, whole: Path) -> None:
    with whole.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        config, copy = list(reader.iter_attachments())
        (about, about_copy) = [r for r in reader.iter_metadata() if r.name == "acsard"]
        (how_to_read,) = [r for r in reader.iter_metadata() if r.name == HOW_TO_READ.name]
        contents = {c.topic: c.metadata["content"] for c in summary.channels.values()}
    assert topics.count("steps") == -(-len(tape.taken) // BATCH)
    assert summary.statistics.message_count == len(topics)
    assert config.name == "acsard.toml"
    assert (config, about) == (copy, about_copy)
    assert "acsard recording export" in how_to_read.metadata["export"]
    assert "an array of first, mono_ns, " in contents["steps"]
    assert contents.keys() == {"steps", "state", "events", "unfinished"}


def on_a_machine(tape: Tape) -> None:
    """Replace the times of the recorded steps by times as on a quiet machine.

    A step is some tens of µs late, and each read is some µs older than its step.
    """
    dice = random.Random(1)
    for at, step in enumerate(tape.taken):
        late = 1000 * round(dice.expovariate(1 / 30))
        mono, wall = step.inputs.now.mono_ns + late, step.inputs.now.wall_ns + late
        now = Instant(mono, wall + 1000 * dice.randint(0, 1))
        reads = tuple(
            replace(read, at=Instant(mono - age, wall - age))
            for read in step.inputs.received
            if (age := 1000 * dice.randint(5, 15))
        )
        tape.taken[at] = step._replace(inputs=replace(step.inputs, now=now, received=reads))


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "most"), [(None, 90e6), (0.5, 400e6)])
def test_an_idle_day_takes_less_than_90_mb_and_a_day_of_driving_less_than_400(
    speed: float | None, most: float, tmp_path: Path
) -> None:
    tape, sizes = Tape(), []
    world = World(recorder=tape)
    world.run(3.0)
    if speed is not None:
        world.drive(speed, 0.2, seconds=1.0, hz=20.0)
    del tape.taken[:-BATCH]
    for seconds in (0.0, 10.0):
        if speed is None:
            world.run(seconds)
        else:
            world.hold(speed, 0.2, seconds=seconds)
        path, now_ns = tmp_path / f"{seconds}.mcap", world.now_ns
        on_a_machine(tape)
        tape.write(path, Config(), apart=False)
        sizes.append((path.stat().st_size, now_ns))
    (little, began_ns), (much, ended_ns) = sizes
    assert 0 < (much - little) / ((ended_ns - began_ns) / 1e9) * 86_400 < most


def test_only_the_service_and_its_group_may_read_a_recording(whole: Path) -> None:
    assert whole.stat().st_mode & 0o777 == FILE_MODE == 0o640


@pytest.mark.parametrize(
    "cuts", [30, pytest.param(1000, marks=[pytest.mark.slow, pytest.mark.nightly])]
)
def test_every_complete_chunk_of_a_cut_file_is_read(whole: Path, tmp_path: Path, cuts: int) -> None:
    data, dice, path = whole.read_bytes(), random.Random(1), tmp_path / "cut.mcap"
    (first, _), *_ = ends = chunks(data)
    every = numbers(whole)
    for _ in range(cuts):
        size = dice.randrange(first, len(data))
        tail = dice.choice([b"", bytes(512), dice.randbytes(64)])
        path.write_bytes(data[:size] + tail)
        count = sum(end <= size for _, end in ends)
        indices = numbers(path)
        assert indices == every[: len(indices)]
        assert len(indices) >= count * BATCH or indices == every


def test_every_second_that_was_synced_can_be_read_before_its_chunk_ends(
    tape: Tape, tmp_path: Path
) -> None:
    path, now = tmp_path / "part.mcap", tape.taken[0].inputs.now
    config = "\n".join(document(effective(Config())))
    writing = RecordingWriter(
        path, About("acsar", "0.1.0", "3.11.0", now.mono_ns, now.wall_ns, config)
    )
    for at in range(0, len(tape.taken), BATCH):
        batch = tape.taken[at : at + BATCH]
        writing.add("steps", batch[0].inputs.now.wall_ns, encode(at, batch))
        writing.flush()
        assert numbers(path) == list(range(at + len(batch)))
        ((_, claimed),) = chunks(path.read_bytes())
        assert claimed > path.stat().st_size
        recording = Recording(path)
        list(recording.messages())
        assert (recording.ended, recording.damaged) == (False, 0)
    writing.finish()
    assert len(chunks(path.read_bytes())) == 1
    assert numbers(path) == list(range(len(tape.taken)))


SECTOR = 512
"""Bytes that a disk writes at once."""


@pytest.mark.slow
def test_a_power_cut_in_the_middle_of_a_sync_costs_nothing_of_the_syncs_before(
    tape: Tape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the power fails, any of the sectors of the last sync may be on the disk.

    The sync may also be the one at the end of a chunk or of the file.
    """
    path, cut, now = tmp_path / "part.mcap", tmp_path / "cut.mcap", tape.taken[0].inputs.now
    monkeypatch.setattr("acsard.recording.mcap_file.CHUNK_NS", 3 * NS_PER_S)
    synced: list[bytes] = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(path.read_bytes()))
    config = "\n".join(document(effective(Config())))
    writing = RecordingWriter(
        path, About("acsar", "0.1.0", "3.11.0", now.mono_ns, now.wall_ns, config)
    )
    for at in range(0, len(tape.taken), BATCH):
        batch = tape.taken[at : at + BATCH]
        writing.add("steps", batch[0].inputs.now.wall_ns, encode(at, batch))
        writing.flush()
    writing.finish()
    assert len(chunks(synced[-1])) > 1
    dice = random.Random(7)
    for before, after in pairwise(synced[1:]):
        path.write_bytes(before)
        safe = numbers(path)
        for _ in range(20):
            old = before.ljust(len(after), b"\0")
            sectors = range(0, dice.choice([len(before), len(after)]), SECTOR)
            cut.write_bytes(b"".join(dice.choice([old, after])[at : at + SECTOR] for at in sectors))
            assert numbers(cut)[: len(safe)] == safe


def test_a_chunk_covers_about_ten_seconds_and_a_jump_of_the_clock_ends_it(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    writing = RecordingWriter(path, About("acsar", "0.1.0", "3.11.0", 1, 2))
    for second in (*range(25), 1_000_000, 3):
        writing.add("steps", second * NS_PER_S, b"steps of one second")
        writing.flush()
    writing.finish()
    with path.open("rb") as stream:
        records = [
            r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)
        ]
    times = [(r.message_start_time // NS_PER_S, r.message_end_time // NS_PER_S) for r in records]
    assert times == [(0, 9), (10, 19), (20, 24), (1_000_000, 1_000_000), (3, 3)]


def test_a_chunk_has_at_most_about_a_mebibyte(tmp_path: Path) -> None:
    path = tmp_path / "much.mcap"
    writing = RecordingWriter(path, About("acsar", "0.1.0", "3.11.0", 1, 2))
    for _ in range(40):
        writing.add("steps", 5, bytes(100_000))
    writing.finish()
    with path.open("rb") as stream:
        records = [
            r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)
        ]
    assert len(records) == 4
    assert max(chunk.uncompressed_size for chunk in records) < CHUNK_BYTES + 110_000


@pytest.mark.parametrize("cuts", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_file_that_was_cut_before_its_first_chunk_is_refused_with_a_message(
    whole: Path, tmp_path: Path, cuts: int
) -> None:
    data, dice, path = whole.read_bytes(), random.Random(5), tmp_path / "cut.mcap"
    (first, _), *_ = chunks(data)
    config_end = data.index(b"acsard.TimelineEntry") - 15  # the head of the record with this name
    for _ in range(cuts):
        size = dice.randrange(first)
        tail = dice.choice([b"", bytes(512), dice.randbytes(64)])
        path.write_bytes(data[:size] + tail)
        with pytest.raises(RecordingError) as refused:
            replay_file(Recording(path))
        text = str(refused.value)
        assert (str(path) in text, text.isprintable()) == (True, True)
        if not tail:
            lacks = (
                "has no readable steps"
                if size >= config_end
                else "the beginning of the file is missing"
            )
            assert lacks in text


@pytest.mark.parametrize("files", [15, pytest.param(200, marks=pytest.mark.slow)])
def test_all_undamaged_chunks_of_a_damaged_file_are_read(
    whole: Path, tmp_path: Path, files: int
) -> None:
    data, dice, path = whole.read_bytes(), random.Random(2), tmp_path / "damaged.mcap"
    spans, hits = chunks(data), 0
    for _ in range(files):
        bad = bytearray(data)
        hit = dice.randrange(len(spans))
        start, end = spans[hit]
        # The damage includes the chunk's head: its type, length, times and compression.
        at = dice.randrange(start, dice.choice([start + 60, end]))
        bad[at] ^= 1 << dice.randrange(8)
        path.write_bytes(bad)
        recording = Recording(path)
        indices = [step.number for step in steps(recording)]
        assert recording.damaged == 1 or indices == numbers(whole)  # the bit has no meaning
        assert recording.is_intact == (recording.damaged == 0)
        hits += recording.damaged
        assert recording.ended
        assert set(range(max(numbers(whole)) + 1)) - set(indices) <= set(
            range(hit * BATCH, (hit + 1) * BATCH)
        )
    assert files / 2 < hits < files


@pytest.mark.parametrize("hit", [0, 2, -1])
@pytest.mark.parametrize("place", [0, 1, 8])
def test_a_chunk_whose_head_is_damaged_costs_nothing(
    place: int, hit: int, whole: Path, tmp_path: Path
) -> None:
    """The test damages each byte of the type and of the length in turn."""
    bad, path = bytearray(whole.read_bytes()), tmp_path / "head.mcap"
    bad[chunks(bad)[hit][0] + place] ^= 0x41
    path.write_bytes(bad)
    assert numbers(path) == numbers(whole)


def test_two_neighbouring_damaged_chunks_cost_no_other_chunk(whole: Path, tmp_path: Path) -> None:
    """The first chunk's header gives the length of both, and its content is damaged as well."""
    bad, path = bytearray(whole.read_bytes()), tmp_path / "two.mcap"
    (begin, middle), (_, end) = chunks(bad)[1:3]
    bad[begin + 1 : begin + 9] = (end - begin - 9).to_bytes(8, "little")
    bad[begin + 80 : middle + 80] = bytes(middle - begin)
    path.write_bytes(bad)
    every = numbers(whole)
    assert numbers(path) == every[:BATCH] + every[3 * BATCH :]
    recording = Recording(path)
    list(recording.messages())
    assert (recording.ended, recording.is_intact) == (True, False)


def test_the_beginnings_of_two_neighbouring_damaged_chunks_are_read(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    writing = RecordingWriter(path, About("acsar", "0.1.0", "3.11.0", 1, 2))
    for _ in range(4):
        for second in range(5):
            writing.add("steps", second, random.Random(second).randbytes(500))
            writing.flush()
        writing.end_chunk()
    writing.finish()
    every = [wall_ns for _, wall_ns, _ in Recording(path).messages()]
    bad = bytearray(path.read_bytes())
    for begin, end in chunks(bad)[1:3]:
        at = (begin + end) // 2
        bad[at : end - 3] = b"\xff" * (end - 3 - at)
    path.write_bytes(bad)
    recording = Recording(path)
    assert every == [0, 1, 2, 3, 4] * 4
    read = [wall_ns for _, wall_ns, _ in recording.messages()]
    assert read == [0, 1, 2, 3, 4, 0, 1, 0, 1, 0, 1, 2, 3, 4]
    assert (recording.damaged, recording.ended) == (2, True)


@pytest.mark.slow
def test_random_bytes_in_a_file_raise_only_recording_errors(whole: Path, tmp_path: Path) -> None:
    data, dice, path = whole.read_bytes(), random.Random(3), tmp_path / "random.mcap"
    errors: list[str] = []
    for _ in range(40):
        bad = bytearray(data)
        for _ in range(dice.randint(1, 20)):
            bad[dice.randrange(len(bad))] = dice.randrange(256)
        path.write_bytes(bad)
        try:
            replay_file(Recording(path))
        except RecordingError as error:
            errors.append(str(error))
    assert errors
    assert all(str(path) in text for text in errors)


@pytest.mark.parametrize("data", [b"", b"\x89MCAP", b"hello" * 100])
def test_a_file_of_another_program_is_refused_with_a_message(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="not a recording of acsard"):
        Recording(path)
    with pytest.raises(RecordingError, match="cannot read"):
        Recording(tmp_path / "none")


@pytest.mark.parametrize("name", ["wall_ns", "mono_ns", "started_ns"])
def test_a_time_outside_of_the_calendar_is_refused(name: str, tmp_path: Path) -> None:
    now = Config()
    about = About(now.robot.id, "0.1.0", "3.11.0", 1, 2, "\n".join(document(effective(now))))
    path = tmp_path / "far.mcap"
    RecordingWriter(path, replace(about, **{name: 1 << 63})).finish()
    with pytest.raises(RecordingError, match=name):
        Recording(path)


def test_an_event_without_a_valid_time_is_refused(tape: Tape, tmp_path: Path) -> None:
    path = tmp_path / "far.mcap"
    tape.write(path, Config())
    recording, far = Recording(path), b'{"seconds": 1e300, "name": "stop", "text": "stopped"}'
    writing = RecordingWriter(tmp_path / "new.mcap", recording.about)
    writing.add("events", 1, far)
    writing.finish()
    with pytest.raises(RecordingError, match="an event that cannot be read"):
        rewrite(Recording(tmp_path / "new.mcap"), tmp_path / "other.mcap")


def test_a_cut_file_is_rewritten_as_a_finished_file(whole: Path, tmp_path: Path) -> None:
    cut, new = tmp_path / "cut.mcap", tmp_path / "new.mcap"
    cut.write_bytes(whole.read_bytes()[: chunks(whole.read_bytes())[3][1] + 20])
    rewrite(Recording(cut), new)
    recording = Recording(new)
    assert [step.number for step in steps(recording)] == numbers(cut) == list(range(4 * BATCH))
    assert recording.is_intact
    assert recording.about == Recording(whole).about
    with new.open("rb") as stream:
        assert len(list(make_reader(stream).iter_messages())) > 0


def test_a_replay_without_a_later_state_ends_at_missing_steps_and_reports_them(
    whole: Path, tmp_path: Path
) -> None:
    data, path = whole.read_bytes(), tmp_path / "gap.mcap"
    start, _ = chunks(data)[2]
    path.write_bytes(data[: start + 70] + bytes(20) + data[start + 90 :])
    result = replay_file(Recording(path))
    assert result.comparison.steps == 2 * BATCH
    assert result.same
    (gap,) = result.gaps
    later = [step for step in steps(Recording(path)) if step.number >= 3 * BATCH]
    assert (gap.unreadable, gap.skipped) == (BATCH, len(later))
    assert gap.lines == sum(step.recorded.line is not None for step in later) > 0


def test_the_end_record_summarizes_the_recording(tape: Tape, whole: Path, tmp_path: Path) -> None:
    first, last = tape.taken[0].inputs.now, tape.taken[-1].inputs.now
    ending = read_end(whole)
    assert ending is not None
    assert (ending.wall_ns, ending.said) == (
        first.wall_ns,
        "start, 1 change of commander, 1 stop (stopped by unnamed (native))",
    )
    assert 0 <= last.wall_ns - ending.last_ns < 2e9
    cut, new = tmp_path / "cut.mcap", tmp_path / "new.mcap"
    cut.write_bytes(whole.read_bytes()[:-100])
    assert read_end(cut) is None
    rewrite(Recording(cut), new)
    assert read_end(new) == replace(ending, cut="open")
    assert ending == EndRecord(
        ending.wall_ns, ending.last_ns, ending.said, earliest_ns=ending.wall_ns, serious=True
    )
    rewrite(Recording(new), tmp_path / "again.mcap", "crash")
    assert read_end(tmp_path / "again.mcap") == read_end(new), "it was finished before"
    assert read_end(tmp_path / "none") is None


def test_a_device_is_not_read_as_a_recording() -> None:
    with pytest.raises(RecordingError, match="it is not a file"):
        Recording(Path("/dev/zero"))


def test_a_recording_that_does_not_fit_into_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_large(self: Path) -> bytes:
        raise MemoryError

    (path := tmp_path / "large.mcap").touch()
    monkeypatch.setattr(Path, "read_bytes", too_large)
    with pytest.raises(RecordingError, match="larger than the free memory"):
        Recording(path)
