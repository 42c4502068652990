"""The file of frames: what is written is read, damage costs its frame, a time is found."""

from __future__ import annotations

import io
import os
import random
import struct
import zlib
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zstandard
from msgspec.structs import replace

from acsard.core.values import Instant, Received, Request
from acsard.host.errors import RecordingError
from acsard.recording import file as recording_file
from acsard.recording.file import MAGIC, SUFFIX, FrameWriter, Head, Recording, encode_steps, listed
from acsard.recording.recorded_steps import FinishedStep
from tests.unit.drives import drive

TAKEN = drive().taken
SECOND = 150  # steps in a record of these tests


def head(number: int, at: Instant) -> Head:
    return Head("0.2.0", "acsar", number, at.mono_ns, at.wall_ns, "[robot]\n", b"state")


def write(taken: list[FinishedStep], ends: list[int] | None = None) -> bytes:
    """Return a file with two seconds in a frame. `ends` gets the end of each second."""
    file = io.BytesIO()
    frames = FrameWriter(file)
    for count, at in enumerate(range(0, len(taken), SECOND)):
        if count % 2 == 0:
            frames.begin(head(at, taken[at].now))
        frames.add(encode_steps(at, taken[at : at + SECOND]))
        if ends is not None:
            ends.append(file.tell())
    frames.end()
    return file.getvalue()


def compressed(plain: bytes, window_log: int = recording_file.WINDOW_LOG) -> bytes:
    """Return a frame with this content."""
    kind = zstandard.ZstdCompressionParameters.from_level(3, window_log=window_log)
    frame = zstandard.ZstdCompressor(compression_params=kind).compressobj()
    return frame.compress(plain) + frame.flush()


def read(path: Path, data: bytes) -> tuple[list[int], Recording]:
    """Return the numbers of the readable steps of a file with this content."""
    path.write_bytes(data)
    recording = Recording([path])
    return [step.number for step in recording.steps()], recording


def frames_in(data: bytes) -> list[int]:
    """Return the offsets of the frames."""
    found, at = [], data.find(MAGIC)
    while at >= 0:
        found.append(at)
        at = data.find(MAGIC, at + 1)
    return found


def test_every_step_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(write(TAKEN))
    recording = Recording([path])
    steps = list(recording.steps())
    assert recording.damage == []
    for step, entry in zip(steps, TAKEN, strict=True):
        assert (step.now, step.heard, step.driven) == (entry.now, entry.heard, entry.driven)
        assert (step.recorded.line, step.recorded.sent) == (entry.line, entry.sent)
        assert step.recorded.status.mode == entry.status.mode
        assert step.recorded.events == entry.news.events
    assert [step.number for step in steps if step.begins] == list(range(0, len(TAKEN), SECOND))
    assert recording.head() == head(0, TAKEN[0].now)


def test_each_read_of_the_port_has_its_own_time(tmp_path: Path) -> None:
    """The first steps behind an open port have the bytes from which the line is recognized."""
    entry, path = TAKEN[7], tmp_path / "a"
    now = entry.now
    reads = tuple(
        Received(Instant(now.mono_ns - early_ns, now.wall_ns - early_ns + set_ns), b"ap")
        for early_ns, set_ns in ((3_000_000, 500), (1_000_000, 0))
    )
    path.write_bytes(write([entry._replace(heard=replace(entry.heard, received=reads))]))
    (step,) = Recording([path]).steps()
    assert step.heard.received == reads


def test_steps_that_are_too_many_for_one_record_are_in_several(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_file, "MAX_RECORD_BYTES", 10_000)
    file = io.BytesIO()
    frames = FrameWriter(file)
    frames.begin(head(0, TAKEN[0].now))
    frames.add_steps(0, TAKEN)
    frames.end()
    (tmp_path / "a").write_bytes(file.getvalue())
    recording = Recording([tmp_path / "a"])
    steps = list(recording.steps())
    assert [step.number for step in steps] == list(range(len(TAKEN)))
    assert sum(step.begins for step in steps) > 2
    assert recording.damage == []


# damage


def test_a_file_that_was_cut_off_at_any_byte_has_every_complete_second(tmp_path: Path) -> None:
    ends: list[int] = []
    data = write(TAKEN, ends)
    for cut in (*range(6), *range(0, len(data), len(data) // 50)):
        numbers, recording = read(tmp_path / "a", data[:cut])
        complete = sum(end <= cut for end in ends)
        assert numbers == list(range(min(complete * SECOND, len(TAKEN)))), cut
        assert recording.damage == [], cut


def test_damage_costs_the_rest_of_its_frame_and_is_said(tmp_path: Path) -> None:
    data, dice = write(TAKEN), random.Random(1)
    starts = [*frames_in(data), len(data)]
    for _ in range(60):
        at = dice.randrange(len(data) - 16)
        damaged = data[:at] + dice.randbytes(16) + data[at + 16 :]
        numbers, recording = read(tmp_path / "a", damaged)
        hit = [i for i in range(len(starts) - 1) if starts[i] < at + 16 and at < starts[i + 1]]
        whole = {n for n in range(len(TAKEN)) if n // (2 * SECOND) not in hit}
        assert whole <= set(numbers), at
        assert numbers == sorted(set(numbers)), at
        # The last bytes of a frame are its end mark only, which nothing needs.
        assert recording.damage or len(numbers) == len(TAKEN), at


def test_a_damaged_length_costs_only_its_frame(tmp_path: Path) -> None:
    """The second frame seems to have a block that reaches beyond the end of the file."""
    data = bytearray(write(TAKEN))
    block = frames_in(bytes(data))[1] + len(MAGIC) + 2
    data[block : block + 3] = (131_000 << 3 | 2 << 1).to_bytes(3, "little")
    numbers, recording = read(tmp_path / "a", bytes(data))
    assert numbers == [n for n in range(len(TAKEN)) if not 2 * SECOND <= n < 4 * SECOND]
    assert len(recording.damage) == 1


def test_a_file_that_is_no_recording_is_refused_in_words(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "missing", tmp_path, tmp_path / "pipe"):
        with pytest.raises(RecordingError, match="cannot read"):
            list(Recording([path]).records())
    path = tmp_path / "a"
    for content in (b"no recording", b"\x1f\x8b\x08", b"\x89MCAP0\r\n"):
        with pytest.raises(RecordingError, match="not a recording of acsard"):
            read(path, content)
    os.truncate(path, recording_file.MAX_FILE_BYTES + 1)
    with pytest.raises(RecordingError, match="more than 256 MB"):
        list(Recording([path]).records())


def test_a_second_with_a_wrong_checksum_is_left_out(tmp_path: Path) -> None:
    """A disk may lose a part of what the compression then repeats."""
    data = write(TAKEN[: 2 * SECOND])
    plain = bytearray(zstandard.ZstdDecompressor().decompressobj().decompress(data))
    plain[-1] ^= 1
    numbers, recording = read(tmp_path / "a", compressed(bytes(plain)))
    assert numbers == [*range(SECOND)]
    assert "checksum" in str(recording.damage[0])


def test_a_frame_that_would_need_much_memory_is_left_out(tmp_path: Path) -> None:
    """The window is bounded, and so is a record: 16 MB of zeros take 700 bytes of a file."""
    for frame, why in (
        (compressed(b"\0\0\0\1" + bytes(1 << 20), window_log=27), "memory"),
        (compressed(b"\xff\xff\xff\xff\0\0\0\0" + bytes(1 << 25)), "a record has"),
    ):
        numbers, recording = read(tmp_path / "a", frame)
        (damage,) = recording.damage
        assert numbers == []
        assert why in str(damage)


# other versions


def test_a_newer_version_may_add_fields_and_services_and_an_older_one_lack_them(
    tmp_path: Path,
) -> None:
    def step_of(*records: Any) -> Any:
        file = io.BytesIO()
        frames = FrameWriter(file)
        frames.begin(records[0])
        frames.add(records[1])
        frames.end()
        (tmp_path / "a").write_bytes(file.getvalue())
        recording = Recording([tmp_path / "a"])
        (step,) = recording.steps()
        assert recording.damage == []
        return step

    row = msgspec.to_builtins(encode_steps(0, TAKEN[:1]).rows[0], builtin_types=(bytes,))
    row[3] |= {"added": 1, "requests": [{"verb": "dance"}, {"verb": "stop", "loudly": True}]}
    begin = msgspec.to_builtins(head(0, Instant(0, 0)), builtin_types=(bytes,))
    steps = {"type": "steps", "first": 0, "rows": [[*row, "added"]], "checksum": 0, "added": {}}
    assert step_of(begin | {"added": [1]}, steps).heard.requests == (Request("stop"),)
    status = {"mode": "ready", "code": "no_command", "reason": "why", "link": "up"}
    rows = [[5, 7, [], {"port_open": True}, True, None, None, "", 0, status, [], []]]
    begin = {"type": "head", "version": "0.2.0", "robot": "r", "number": 0, "mono_ns": 0}
    step = step_of(begin | {"wall_ns": 0}, steps | {"rows": rows})
    assert (step.now, step.recorded.status.mode) == (Instant(5, 12), "ready")


# parts


def test_steps_between_two_times_are_found_over_all_files(tmp_path: Path) -> None:
    walls, half = [entry.now.wall_ns for entry in TAKEN], 2 * SECOND
    paths = [tmp_path / "1", tmp_path / "2"]
    for path, part in zip(paths, (TAKEN[:half], TAKEN[half:]), strict=True):
        path.write_bytes(write(part))
    for begin in range(0, len(TAKEN), 300):
        for end in (begin, begin + 10, begin + half, len(TAKEN) - 1):
            at = walls[begin], walls[min(end, len(walls) - 1)]
            expected = [n % half if n < half else n - half for n, w in enumerate(walls)
                        if at[0] <= w <= at[1]]  # fmt: skip
            found = [step.number for step in Recording(paths, *at).steps()]
            assert found == expected, (begin, end)


def test_the_files_of_a_directory_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    names = ["000010-19700101T000000Z", "000009-20261129T000000Z", "1000000-20261129T000000Z"]
    for name in [*names, "x-20261129T000000Z", "11"]:
        (tmp_path / f"{name}{SUFFIX}").touch()
    (tmp_path / "000001-20261129T000000Z.mcap").touch()
    os.mkfifo(tmp_path / f"000002-x{SUFFIX}")
    (tmp_path / f"000003-x{SUFFIX}").symlink_to(tmp_path / "11")
    found = [path.name.removesuffix(SUFFIX) for path in listed(tmp_path)]
    assert found == [names[1], names[0], names[2]]


def framed(*records: bytes) -> bytes:
    """Return a frame with these records under good checksums."""
    parts = [struct.pack("<II", len(record), zlib.crc32(record)) + record for record in records]
    return compressed(b"".join(parts))


def test_a_frame_with_two_heads_or_an_endless_record_costs_itself_alone(tmp_path: Path) -> None:
    good, encoded = write(TAKEN[:SECOND]), msgspec.msgpack.encode(head(0, TAKEN[0].now))
    endless = compressed(struct.pack("<II", 1 << 31, 0) + bytes(100))
    for bad, why in (
        (framed(encoded, encoded), "does not have one head"),
        (framed(encoded) + endless + framed(encoded), "a record has 2147483648 bytes"),
    ):
        numbers, recording = read(tmp_path / "a", good + bad + good)
        assert numbers == 2 * list(range(SECOND))
        (damage,) = recording.damage
        assert why in str(damage)
