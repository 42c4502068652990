"""A reader can read a growing chunk after each second, and a damaged one up to the damage."""

from __future__ import annotations

import io
import random
import struct
import time

import pytest
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk
from mcap.stream_reader import breakup_chunk

from acsard.recording.mcap_records import (
    GROWING_HEAD,
    LAST_BLOCK,
    MAGIC,
    MAX_MESSAGE_BYTES,
    ZSTD_NAME_FIELD,
    ZSTD_PARAMETERS,
    GrowingChunk,
    Message,
    chunk_places,
    read_chunk,
    walk,
)
from tests.each import each

DICE = random.Random(1)

SECONDS = [
    [Message(1, 1_000 * n + k, b"a line of the board " * 40 + DICE.randbytes(60)) for k in range(3)]
    for n in range(10)
]
"""The messages of ten seconds."""

ALL = [message for second in SECONDS for message in second]


def grown(seconds: list[list[Message]]) -> tuple[bytes, list[int], bytes]:
    """Return a growing chunk's bytes, the end of each second in them, and the complete chunk."""
    chunk, data, ends = GrowingChunk(), GROWING_HEAD, []
    for second in seconds:
        for message in second:
            chunk.add(message)
        data += chunk.take()
        ends.append(len(data))
    last, head = chunk.end()
    return data, ends, head + (data + last)[len(head) :]


GROWS, ENDS, COMPLETE = grown(SECONDS)


def test_a_growing_chunk_has_all_seconds_written_so_far() -> None:
    for number, end in enumerate(ENDS, start=1):
        result = read_chunk(GROWS[:end], 0)
        assert result is not None
        assert result.messages == [message for second in SECONDS[:number] for message in second]
        assert (result.end, result.complete) == (end, False)


@pytest.mark.parametrize("torn", [b"", bytes(700), DICE.randbytes(64)])
def test_a_cut_at_any_byte_costs_only_its_second(torn: bytes) -> None:
    for cut in range(len(GROWING_HEAD), len(GROWS), 7):
        whole = sum(end <= cut for end in ENDS)
        result = read_chunk(GROWS[:cut] + torn, 0)
        assert result is not None
        assert result.messages[: 3 * whole] == ALL[: 3 * whole]
        assert result.messages == ALL[: len(result.messages)]
        assert len(result.messages) <= 3 * (whole + 1)


def test_the_mcap_library_reads_a_complete_chunk_and_a_cut_chunk_that_was_ended() -> None:
    cut = read_chunk(GROWS[: ENDS[6] + 9], 0)
    assert cut is not None
    ended = cut.head(GROWS) + GROWS[len(GROWING_HEAD) : cut.end] + LAST_BLOCK
    for data, messages in ((COMPLETE, ALL), (ended, ALL[:21])):
        result = read_chunk(data, 0)
        assert result is not None
        assert (result.messages, result.end, result.complete) == (messages, len(data), True)
        chunk = Chunk.read(ReadDataStream(io.BytesIO(data[9:])))
        read = breakup_chunk(chunk, validate_crc=True)
        assert [Message(m.channel_id, m.log_time, m.data) for m in read] == messages  # type: ignore[attr-defined]
        assert (chunk.message_start_time, chunk.message_end_time) == (0, messages[-1].wall_ns)
        assert struct.unpack_from("<Q", data, 1)[0] == len(data) - 9


@pytest.mark.slow
def test_damage_never_changes_a_message_and_damage_in_the_head_costs_no_message() -> None:
    for at in range(len(COMPLETE)):
        bad = bytearray(COMPLETE)
        bad[at] ^= 1 << DICE.randrange(8)
        result = read_chunk(bytes(bad), 0)
        if at < len(GROWING_HEAD):
            assert result is None or result.messages == ALL
            continue
        assert result is not None
        second = sum(end <= at for end in ENDS)
        assert result.messages == ALL[: len(result.messages)]
        assert len(result.messages) >= 3 * second


def test_each_compression_name_may_belong_to_the_head_of_a_chunk() -> None:
    assert list(chunk_places(bytes(100) + COMPLETE + COMPLETE, 0)) == [100, 100 + len(COMPLETE)]
    assert read_chunk(bytes(100), 0) is None
    assert read_chunk(ZSTD_NAME_FIELD, 0) is None


@pytest.mark.slow
def test_the_time_to_read_a_chunk_is_proportional_to_the_number_of_its_blocks() -> None:
    chunk, data, message = GrowingChunk(), GROWING_HEAD, Message(1, 5, b"")
    parts = []
    for _ in range(20_000):
        chunk.add(message)
        parts.append(chunk.take())
    data += b"".join(parts)
    began = time.process_time()
    result = read_chunk(data, 0)
    assert result is not None
    assert result.messages == [message] * 20_000
    assert time.process_time() - began < 2.0


def test_the_time_to_read_chunks_that_claim_megabytes_is_proportional_to_their_number() -> None:
    """Each chunk announces a message of 4 MB that does not end.

    The reader must therefore decompress the whole chunk.
    """
    inside = struct.pack("<BQ", 5, MAX_MESSAGE_BYTES - 100) + bytes(MAX_MESSAGE_BYTES - 200)
    packed = zstandard.ZstdCompressor(compression_params=ZSTD_PARAMETERS).compress(inside)
    data = MAGIC + (GROWING_HEAD + packed[:-20]) * 1000
    began = time.process_time()
    assert [result.messages for result in walk(data)] == [[]]
    assert time.process_time() - began < 3.0


FRAME_HEAD = GROWS[len(GROWING_HEAD) :][: zstandard.frame_header_size(GROWS[len(GROWING_HEAD) :])]

LONG = struct.pack("<BQ", 5, MAX_MESSAGE_BYTES - 100)
"""Beginning of a message of 4 MB."""

EACH = len(GROWING_HEAD + FRAME_HEAD + LONG) + 3


def with_a_shared_tail(count: int, tail: bytes, head: bytes = GROWING_HEAD) -> bytes:
    """Return nested chunks.

    Each one contains all later chunks as one raw block, and the same tail.
    """
    parts = []
    for number in range(count):
        size = len(LONG) + EACH * (count - number - 1)
        parts.append(head + FRAME_HEAD + (size << 3).to_bytes(3, "little") + LONG)
    return MAGIC + b"".join(parts) + tail


REPEATED = (1 << 17 << 3 | 2).to_bytes(3, "little") + b"x"
"""A block of 4 bytes that unpacks to 128 KiB."""


def raw(data: bytes) -> bytes:
    """Return a compression block that stores these bytes without compression."""
    return (len(data) << 3).to_bytes(3, "little") + data


@each("first", [b"\0", struct.pack("<BQ", 5, 1 << 28), struct.pack("<BQ", 5, MAX_MESSAGE_BYTES)])
def test_a_few_bytes_that_claim_gigabytes_get_no_memory(first: bytes) -> None:
    """The first byte of a message is its type. The next eight bytes are its length."""
    data = GROWING_HEAD + FRAME_HEAD + raw(first) + REPEATED * 30_000
    began = time.process_time()
    result = read_chunk(data, 0)
    assert result is not None
    assert (result.messages, result.complete) == ([], False)
    assert time.process_time() - began < 0.5


NEXT = GROWING_HEAD[:1] + struct.pack("<Q", EACH - 9) + GROWING_HEAD[9:]
"""Head of a chunk whose record ends at the next chunk."""


@each(
    ("tail", "head"),
    [(REPEATED * 62, GROWING_HEAD), (REPEATED * 62, NEXT), (b"\x0a\0\0x" * 4000, GROWING_HEAD)],
)
def test_the_time_to_read_chunks_that_share_their_end_is_limited(tail: bytes, head: bytes) -> None:
    data = with_a_shared_tail(1000, tail, head)
    began = time.process_time()
    results = list(walk(data))
    assert time.process_time() - began < 1.0
    assert (results[-1].end, results[-1].damaged) == (len(data), True)
    assert not any(result.messages for result in results)


def test_the_beginnings_of_damaged_chunks_and_the_complete_chunk_after_them_are_read() -> None:
    bad = bytearray(COMPLETE)
    bad[ENDS[4] + 3 :] = b"\xff" * (len(bad) - ENDS[4] - 3)
    *damaged, last = walk(MAGIC + bytes(bad) * 200 + COMPLETE)
    assert last.messages == ALL
    assert [result.messages for result in damaged] == [ALL[:15]] * 200
    assert all(result.damaged for result in damaged)
