"""acsard recovers a truncated file in place if the disk has no room for a copy."""

from __future__ import annotations

import errno
import os
import random
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from acsard.core.config.settings import Config
from acsard.recording.end_record import END_RECORD_NAME, read_end
from acsard.recording.mcap_file import CHUNK_BYTES, HOW_TO_READ, About, Recording, RecordingWriter
from acsard.recording.mcap_records import GROWING_HEAD, LAST_BLOCK
from acsard.recording.recovery import MAX_DELETED_BYTES, recover
from tests.scenarios.taped import Tape, chunks
from tests.scenarios.world import World


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    tape, path = Tape(), tmp_path_factory.mktemp("record") / "whole.mcap"
    world = World(recorder=tape)
    world.drive(0.5, 0.2, seconds=4.0)
    world.call("stop")
    world.run(0.5)
    tape.write(path, Config())
    return path.read_bytes()


@pytest.fixture(scope="module")
def growing(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Provide a file whose only chunk is incomplete, as a crash leaves it."""
    tape, path = Tape(), tmp_path_factory.mktemp("record") / "part.mcap"
    World(recorder=tape).drive(0.5, 0.2, seconds=8.0)
    tape.write(path, Config(), apart=False)
    data = path.read_bytes()
    ((begin, end),) = chunks(data)
    return data[:begin] + GROWING_HEAD + data[begin + len(GROWING_HEAD) : end - len(LAST_BLOCK)]


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    return list(Recording(path).messages())


def read_by_the_library(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        records = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in records]


@pytest.mark.slow
@pytest.mark.parametrize("room", [False, True])
def test_all_readable_data_stays_and_the_end_record_names_the_cut(
    data: bytes, room: bool, tmp_path: Path
) -> None:
    part, whole, dice = tmp_path / "a.part", tmp_path / "a.mcap", random.Random(4)
    (_, first), *_ = chunks(data)
    for _ in range(20):
        tail = dice.choice([b"", bytes(700), dice.randbytes(64)])
        part.write_bytes(data[: dice.randrange(first + 1, len(data) - 8)] + tail)
        os.utime(part, (0, 1e9))
        torn = Recording(part)
        before = list(torn.messages())
        # Random bytes behind the cut may look like the rest of a damaged record.
        assert bool(recover(part, whole, "crash", room)) == (room and torn.damaged > 0)
        assert messages(whole) == before
        recording = Recording(whole)
        assert len(list(recording.messages())) == len(before) > 0
        assert (recording.is_intact, part.exists()) == (True, False)
        assert whole.stat().st_mtime == 1e9
        last = read_end(whole)
        assert last is not None
        assert recording.cut == last.cut
        assert last.last_ns == max(wall_ns for _, wall_ns, _ in before)
        with whole.open("rb") as stream:
            assert len(list(make_reader(stream).iter_messages())) == len(before)


@pytest.mark.parametrize("torn", [b"", b"torn", bytes(700)])
def test_a_disk_that_refuses_the_end_costs_no_chunk_and_is_reported(
    data: bytes, torn: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk without free space fails again and again, in some cases only at a sync."""
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    cut = data[: chunks(data)[-1][1]] + torn
    part.write_bytes(cut)
    os.utime(part, (0, 1e9))

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    text = recover(part, whole, "crash", room=False)
    assert whole.read_bytes() == cut
    assert "a.mcap was cut off. Because the disk is full, the file gets no end record" in text
    assert (part.exists(), whole.stat().st_mtime) == (False, 1e9)


def test_a_copy_that_has_no_room_for_its_header_leaves_its_room_to_the_end_of_the_file(
    data: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    part.write_bytes(data[: chunks(data)[-1][1]])
    before = messages(part)

    def full(handle: int) -> None:
        if [*tmp_path.iterdir()] != [part]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert recover(part, whole, "crash", room=True) == ""
    assert [*tmp_path.iterdir()] == [whole]
    assert messages(whole) == before
    assert read_end(whole) is not None


def test_a_file_finished_in_place_has_the_cause_and_the_summary(
    data: bytes, tmp_path: Path
) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    part.write_bytes(data[: chunks(data)[-1][1] + 3])
    recover(part, whole, "crash", room=False)
    last = read_end(whole)
    assert last is not None
    assert last.cut == "crash"
    assert last.said == "start, 1 change of commander, 1 stop (stopped by unnamed (native))"


def test_a_torn_last_chunk_is_removed_and_a_damaged_chunk_between_others_stays(
    data: bytes, tmp_path: Path
) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    torn = bytearray(data)
    for begin, end in (chunks(data)[1], chunks(data)[-1]):
        torn[begin + 80 : end] = bytes(end - begin - 80)
    part.write_bytes(torn[: chunks(data)[-1][1]])
    recover(part, whole, "crash", room=False)
    recording = Recording(whole)
    assert len(list(recording.messages())) > 2
    assert (recording.ended, recording.damaged) == (True, 1)


@pytest.mark.parametrize(
    ("hit", "text"),
    [
        pytest.param([1], "1 damaged place is left out of a.mcap", id="one"),
        pytest.param([1, 3], "2 damaged places are left out of a.mcap", id="two"),
    ],
)
def test_damage_that_a_copy_leaves_out_is_reported(
    data: bytes, hit: list[int], text: str, tmp_path: Path
) -> None:
    part, whole, bad = tmp_path / "a.part", tmp_path / "a.mcap", bytearray(data)
    for begin, end in [chunks(data)[number] for number in hit]:
        bad[begin + 80 : end] = b"\xff" * (end - begin - 80)
    part.write_bytes(bad[: chunks(data)[-1][1]])
    assert recover(part, whole, "crash", room=True) == text


@pytest.mark.parametrize("room", [False, True])
def test_a_damaged_head_costs_no_message_after_it(data: bytes, room: bool, tmp_path: Path) -> None:
    part, whole, before = tmp_path / "a.part", tmp_path / "a.mcap", tmp_path / "b.mcap"
    before.write_bytes(data)
    bad = bytearray(data[: chunks(data)[-1][1]])
    for (begin, _), place in zip(chunks(data)[1:], (0, 1, 7), strict=False):
        bad[begin + place] ^= 0x41
    part.write_bytes(bad)
    recover(part, whole, "crash", room)
    assert messages(whole) == messages(before)


def test_chunks_whose_beginning_is_damaged_are_not_thrown_away(data: bytes, tmp_path: Path) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    (begin, end), *_ = chunks(data)
    part.write_bytes(data[:8] + bytes(begin - 8) + data[begin:end])
    assert part.stat().st_size < MAX_DELETED_BYTES
    assert "cannot finish a recording" in recover(part, whole, "crash", room=True)
    assert list(tmp_path.iterdir()) == [whole]


@pytest.mark.slow
@pytest.mark.parametrize("room", [False, True])
def test_a_chunk_that_still_grew_keeps_all_its_seconds(
    growing: bytes, room: bool, tmp_path: Path
) -> None:
    part, whole, dice, counts = tmp_path / "a.part", tmp_path / "a.mcap", random.Random(6), set()
    begin = growing.index(GROWING_HEAD) + len(GROWING_HEAD)
    for number in range(30):
        tail = dice.choice([b"", bytes(700), dice.randbytes(64)])
        size = dice.randrange(begin, len(growing)) if number else len(growing)
        part.write_bytes(growing[:size] + tail)
        before = messages(part)
        text = recover(part, whole, "crash", room)
        counts.add(len(before))
        assert bool(before) != ("no intact data" in text)
        if before:
            recording, last = Recording(whole), read_end(whole)
            assert list(recording.messages()) == before
            assert last is not None
            assert (recording.is_intact, recording.cut, last.cut) == (True, "crash", "crash")
            with whole.open("rb") as stream:
                assert len(list(make_reader(stream).iter_messages())) == len(before)
        assert list(tmp_path.iterdir()) == [whole]
        whole.unlink()
    assert len(counts) > 5


@pytest.mark.parametrize("room", [False, True])
@pytest.mark.parametrize("at", ["file", "chunk"])
def test_a_short_file_with_a_bad_sector_at_its_beginning_stays_and_is_reported(
    growing: bytes, at: str, room: bool, tmp_path: Path
) -> None:
    """The file stays, because a later version of acsard may read the seconds after the bad sector.

    This version cannot read them.
    """
    part, whole, bad = tmp_path / "a.part", tmp_path / "a.mcap", bytearray(growing)
    begin = growing.index(GROWING_HEAD) + len(GROWING_HEAD) if at == "chunk" else 0
    bad[begin : begin + 512] = bytes(512)
    assert len(bad) < MAX_DELETED_BYTES
    part.write_bytes(bad)
    assert "its file now has the name a.mcap" in recover(part, whole, "crash", room)
    assert whole.read_bytes() == bad
    assert not part.exists()


@pytest.mark.parametrize("tail", [b"", bytes(700), b"torn"])
def test_a_kill_before_the_head_of_a_complete_chunk_leaves_a_file_that_any_reader_opens(
    growing: bytes, tail: bytes, tmp_path: Path
) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    part.write_bytes(growing + LAST_BLOCK + tail)
    before = messages(part)
    assert recover(part, whole, "crash", room=False) == ""
    assert read_by_the_library(whole) == before == messages(whole)


def test_a_power_cut_before_the_heads_of_several_chunks_leaves_a_file_that_any_reader_opens(
    data: bytes, tmp_path: Path
) -> None:
    part, whole, bad = tmp_path / "a.part", tmp_path / "a.mcap", bytearray(data)
    part.write_bytes(data)
    before = messages(part)
    for begin, _ in chunks(data):
        bad[begin : begin + len(GROWING_HEAD)] = GROWING_HEAD
    part.write_bytes(bad[: chunks(data)[-1][1]])
    assert recover(part, whole, "crash", room=False) == ""
    assert read_by_the_library(whole) == before == messages(whole)


@pytest.mark.parametrize("tail", [b"", bytes(700)])
def test_a_recovery_in_place_that_a_power_cut_interrupted_is_completed(
    growing: bytes, tail: bytes, tmp_path: Path
) -> None:
    """The power failed when the file's end was on the disk and the chunk's header was not."""
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    part.write_bytes(growing)
    recover(part, whole, "crash", room=False)
    recovered, begin = whole.read_bytes(), growing.index(GROWING_HEAD)
    part.write_bytes(
        recovered[:begin] + GROWING_HEAD + recovered[begin + len(GROWING_HEAD) :] + tail
    )
    whole.unlink()
    assert recover(part, whole, "open", room=False) == ""
    assert whole.read_bytes() == recovered


@pytest.mark.parametrize("cut", ["growing", "between chunks", "in the end"])
def test_a_recovery_in_place_writes_the_statistics_and_the_index_of_a_finished_file(
    data: bytes, growing: bytes, cut: str, tmp_path: Path
) -> None:
    """Some MCAP readers show an empty file without them."""
    part, whole, copy = tmp_path / "a.part", tmp_path / "a.mcap", tmp_path / "b.mcap"
    behind = data.rindex(b"acsard end", 0, -400) + 300
    cuts = {"growing": growing, "between chunks": data[: chunks(data)[-1][1]]}
    part.write_bytes(cuts.get(cut, data[:behind]))
    copy.write_bytes(part.read_bytes())
    assert recover(part, whole, "crash", room=False) == ""
    other = tmp_path / "c.mcap"
    assert recover(copy, other, "crash", room=True) == ""
    results = []
    for path in (whole, other):
        with path.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            named = [record.name for record in reader.iter_metadata()]
            attached = [record.name for record in reader.iter_attachments()]
            # A copy unites short chunks.
            counts = (summary.statistics.metadata_count, summary.statistics.attachment_count)
            assert counts == (len(named), len(attached))
            plain = replace(summary.statistics, chunk_count=0, metadata_count=0, attachment_count=0)
            results.append((plain, named, attached))
    assert results[0][0] == results[1][0]
    assert results[0][0].message_count == len(messages(whole))
    how = HOW_TO_READ.name
    # The copy repeats its beginning at its end, for which a full disk may have no room.
    assert results[0][1:] == ([how, "acsard", END_RECORD_NAME], ["acsard.toml"])
    assert results[1][1:] == ([how, "acsard", "acsard", END_RECORD_NAME], ["acsard.toml"] * 2)


def test_a_recovery_in_place_holds_one_chunk_in_memory_and_not_the_unpacked_file(
    tmp_path: Path,
) -> None:
    part, whole, count = tmp_path / "a.part", tmp_path / "a.mcap", 20
    writing = RecordingWriter(part, About("acsar", "0.1.0", "3.11.0", 1, 2))
    for second in range(count):
        writing.add("state", second, bytes(CHUNK_BYTES))
        writing.end_chunk()
    writing.flush()
    writing.close()
    tracemalloc.start()
    try:
        assert recover(part, whole, "crash", room=False) == ""
        assert tracemalloc.get_traced_memory()[1] < count * CHUNK_BYTES / 2
    finally:
        tracemalloc.stop()
    assert len(messages(whole)) == count


def test_an_empty_file_is_removed_and_an_unreadable_file_is_reported(tmp_path: Path) -> None:
    part, whole = tmp_path / "a.part", tmp_path / "a.mcap"
    for content, phrase in ((b"", ""), (b"\x89MC", "its beginning is missing")):
        part.write_bytes(content)
        text = recover(part, whole, "crash", room=True)
        assert phrase in text
        assert bool(text) == bool(phrase)
        assert list(tmp_path.iterdir()) == []
    part.write_bytes(b"\x89MC" + bytes(MAX_DELETED_BYTES))
    assert "cannot finish a recording" in recover(part, whole, "crash", room=True)
    assert list(tmp_path.iterdir()) == [whole]
