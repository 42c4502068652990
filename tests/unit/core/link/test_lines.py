"""However the bytes are cut into pieces, they give the same lines.

Noise destroys only the lines that it hits. Each newline begins a new line.
"""

from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.lines import MAX_LINE_BYTES, LineReader
from tests.each import each
from tests.vectors.lines import SEED_LINE, SEED_REPLY, ZERO

pieces = st.one_of(
    st.sampled_from([SEED_LINE + b"\r\n", SEED_REPLY + b"\n", ZERO + b"\r\n"]),
    st.sampled_from([b"\n", b"\r\n", b"\r", b"\r\r\n", SEED_LINE[:17], b"\x00\xff"]),
    st.integers(MAX_LINE_BYTES - 3, 3 * MAX_LINE_BYTES).map(lambda n: b"x" * n),
    st.binary(max_size=40),
)
"""Anything that a wire may carry: lines, line ends, halves, runs near the maximum length, noise."""

streams = st.lists(pieces, max_size=12).map(b"".join)


def feed(reader: LineReader, *chunks: bytes) -> list[bytes]:
    """Feed the chunks in order, and return all lines."""
    return [line for chunk in chunks for line, _ in reader.feed(chunk)]


def cut_at(data: bytes, places: set[int]) -> list[bytes]:
    ends = sorted(place for place in places if place <= len(data))
    return [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)], strict=True)]


def test_a_line_ends_with_lf_or_cr_lf() -> None:
    assert feed(LineReader(), b"one\ntwo\r\n") == [b"one", b"two"]


def test_a_line_without_its_line_end_is_not_returned_yet() -> None:
    reader = LineReader()
    assert feed(reader, SEED_LINE + b"\r") == []
    assert feed(reader, b"\n") == [SEED_LINE]


def test_empty_lines_are_dropped() -> None:
    reader = LineReader()
    assert feed(reader, b"\n\r\n\n" + SEED_LINE + b"\r\n\r\n") == [SEED_LINE]
    assert reader.too_long == 0


def test_a_carriage_return_inside_a_line_stays() -> None:
    assert feed(LineReader(), b"a\rb\r\n") == [b"a\rb"]


@given(data=streams)
def test_feeding_byte_by_byte_gives_the_same_lines_as_feeding_all_at_once(data: bytes) -> None:
    whole, single = LineReader(), LineReader()
    expected = feed(whole, data)
    assert feed(single, *(data[i : i + 1] for i in range(len(data)))) == expected
    assert single.too_long == whole.too_long


@given(data=streams, places=st.sets(st.integers(0, 500)))
def test_feeding_pieces_cut_anywhere_gives_the_same_lines(data: bytes, places: set[int]) -> None:
    whole, cut = LineReader(), LineReader()
    expected = feed(whole, data)
    assert feed(cut, *cut_at(data, places)) == expected
    assert cut.too_long == whole.too_long


@given(data=streams)
def test_the_lines_are_the_text_split_at_newlines_without_empty_and_over_long_ones(
    data: bytes,
) -> None:
    *ended, _ = (data + b"\n").split(b"\n")
    allowed = [
        line for line in ended if len(line) + 1 <= MAX_LINE_BYTES and line not in (b"", b"\r")
    ]
    reader = LineReader()
    assert feed(reader, data + b"\n") == [line.removesuffix(b"\r") for line in allowed]
    assert reader.too_long == sum(len(line) + 1 > MAX_LINE_BYTES for line in ended)


def test_the_longest_line_has_128_bytes_with_its_end() -> None:
    reader = LineReader()
    assert feed(reader, b"x" * 127 + b"\n", b"x" * 126 + b"\r\n") == [b"x" * 127, b"x" * 126]
    assert feed(reader, b"x" * 128 + b"\n", b"x" * 127 + b"\r\n") == []
    assert reader.too_long == 2


@each("length", [1, 7, 127, 128, 129, 1000])
def test_after_an_over_long_line_the_next_newline_resynchronises(length: int) -> None:
    reader, noise = LineReader(), b"x" * 1000
    chunks = [noise[i : i + length] for i in range(0, 1000, length)]
    assert feed(reader, *chunks, SEED_LINE + b"\r\n", SEED_REPLY + b"\r\n") == [SEED_REPLY]
    assert reader.too_long == 1


def test_noise_without_newline_is_counted_once() -> None:
    reader = LineReader()
    for _ in range(1000):
        assert reader.feed(b"\xff" * 100) == []
    assert reader.too_long == 1


def test_noise_without_newline_never_grows_memory() -> None:
    reader = LineReader()
    for size in (1, 100, 127, 128, 10_000, 1_000_000) * 10:
        reader.feed(b"\xff" * size)
        assert len(msgspec.msgpack.encode(reader)) < MAX_LINE_BYTES + 64


def test_each_over_long_line_counts() -> None:
    reader = LineReader()
    reader.feed((b"x" * 500 + b"\n") * 3)
    assert reader.too_long == 3


def test_each_line_has_the_number_of_bytes_that_followed_it() -> None:
    assert LineReader().feed(b"one\r\ntwo\nthr") == [(b"one", 7), (b"two", 3)]


def test_bytes_of_earlier_reads_do_not_count_as_following() -> None:
    reader = LineReader()
    reader.feed(b"one")
    assert reader.feed(b"\r\n") == [(b"one", 0)]


@given(data=streams, places=st.sets(st.integers(0, 500)))
def test_the_bytes_before_those_that_followed_end_with_the_line(
    data: bytes, places: set[int]
) -> None:
    reader, before = LineReader(), b""
    for chunk in cut_at(data, places):
        for line, following in reader.feed(chunk):
            upto = before + chunk[: len(chunk) - following]
            assert upto.endswith((line + b"\r\n", line + b"\n"))
        before += chunk


def test_clear_forgets_half_a_line() -> None:
    reader = LineReader()
    reader.feed(SEED_LINE[:10])
    reader.clear()
    assert feed(reader, SEED_LINE + b"\n") == [SEED_LINE]


def test_clear_ends_the_discarding_of_an_over_long_line() -> None:
    reader = LineReader()
    reader.feed(b"x" * 500)
    reader.clear()
    assert feed(reader, SEED_LINE + b"\n") == [SEED_LINE]
    assert reader.too_long == 1
