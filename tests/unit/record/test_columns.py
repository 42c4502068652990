"""All numbers survive the round trip through their columns, and invalid bytes are refused."""

from __future__ import annotations

import random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.record.columns import EMPTY, MOST, Column, pack, unpack

NUMBERS = st.integers(-(1 << 61), (1 << 61) - 1) | st.integers(-9, 9)

COUNT = 200


def noise(most: int) -> list[int]:
    dice = random.Random(1)
    return [dice.randint(-most, most) for _ in range(COUNT)]


def walk() -> list[int]:
    at, found = 0, []
    for step in noise(31):
        at += 5000 + step
        found.append(at)
    return found


@given(st.lists(NUMBERS, max_size=50))
def test_numbers_come_back(values: list[int]) -> None:
    written = msgspec.msgpack.encode(pack(values))
    assert unpack(msgspec.msgpack.decode(written, type=Column), len(values)) == values


@pytest.mark.parametrize(
    ("values", "places"),
    [
        pytest.param([10**10 + n for n in (*noise(31)[1:], 20_000)], 0, id="around a value"),
        pytest.param(walk(), 1, id="each from the one before"),
        pytest.param(
            [
                10_000 * i + (21, 13, 37, 10, 49, 26, 18, 32)[i % 8] * 100 + n
                for i, n in enumerate(noise(15))
            ],
            8,
            id="in a rhythm",
        ),
        pytest.param([10_003 * i + n for i, n in enumerate(noise(31))], 0, id="along a line"),
    ],
)
def test_what_is_near_to_what_is_expected_takes_a_byte_each(values: list[int], places: int) -> None:
    column = pack(values)
    assert column.places == places
    assert len(column.bits) < COUNT
    assert len(pack([1000 * value for value in values]).bits) == len(column.bits)


@pytest.mark.parametrize("values", [[7] * COUNT, [1000 * n - 9 for n in range(COUNT)], [1 << 60]])
def test_what_is_exactly_as_expected_takes_none(values: list[int]) -> None:
    assert pack(values).bits == b""
    assert unpack(pack(values), len(values)) == values


def test_one_that_is_far_off_makes_the_others_hardly_longer() -> None:
    values = noise(31)
    far = [*values[:-1], 1 << 40]
    assert len(pack(far).bits) < len(pack(values).bits) + 16


@given(st.lists(NUMBERS, min_size=2, max_size=9), st.integers(1, 8))
def test_a_column_of_another_length_is_refused(values: list[int], more: int) -> None:
    column = pack(values)
    if column.bits:
        for other in (len(values) + more, len(values) - 1):
            if other:
                with pytest.raises(ValueError, match=r"column|substring"):
                    unpack(column, other)
        with pytest.raises(ValueError, match=r"column|substring"):
            unpack(replace(column, bits=column.bits[:-1]), len(values))


@pytest.mark.parametrize("what", [{"places": 3}, {"places": -1}, {"order": 65}, {"order": -2}])
def test_what_there_is_not_is_refused(what: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"there are not|there is not"):
        unpack(replace(pack(noise(9)), **what), COUNT)


def test_more_numbers_than_there_can_be_are_refused() -> None:
    with pytest.raises(ValueError, match="too many"):
        unpack(pack([7] * COUNT), 1 << 60)


def test_a_code_of_any_length_is_none() -> None:
    """A few bytes must not produce numbers of thousands of bits, each added to all that follow."""
    zeros = 100_000
    bits = "1" + "1" + "0" * zeros + "1" + "0" * zeros + "1"
    held = int(bits, 2).to_bytes((len(bits) + 7) // 8)
    with pytest.raises(ValueError, match="too many bits"):
        unpack(Column(1, 0, 0, 1, 0, held), 3)


def test_more_numbers_than_a_batch_can_have_are_none() -> None:
    with pytest.raises(ValueError, match="too many numbers"):
        unpack(EMPTY, MOST + 1)
    assert MOST < 100_000
