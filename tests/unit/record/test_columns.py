"""Numbers come back from their columns, whatever they are; other bytes do not."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.record.columns import pack, unpack

NUMBERS = st.integers(-(1 << 61), (1 << 61) - 1)


@given(st.lists(NUMBERS, max_size=50))
def test_numbers_come_back(values: list[int]) -> None:
    assert unpack(pack(values), len(values)) == values


def test_what_hardly_differs_takes_a_byte_each() -> None:
    dice = random.Random(1)
    values = [10_000_000_000 + dice.randint(-60, 60) for _ in range(200)]
    assert len(pack(values)) < 200 + 30
    assert len(pack([1000 * value for value in values])) == len(pack(values))
    assert len(pack([7] * 200)) < 30


@given(st.lists(NUMBERS, min_size=2, max_size=9), st.integers(1, 8))
def test_a_column_of_another_length_is_refused(values: list[int], more: int) -> None:
    data = pack(values)
    if len(data) > 17:
        with pytest.raises(ValueError, match="column"):
            unpack(data, len(values) + more)
    with pytest.raises(ValueError, match="column"):
        unpack(data + b"\x00", len(values))
    with pytest.raises(ValueError, match="column"):
        unpack(data[:5], len(values))
    with pytest.raises(ValueError, match="column"):
        unpack(pack([7] * 200), 1 << 60)
