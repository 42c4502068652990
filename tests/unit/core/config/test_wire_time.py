"""Tests of wire time, wire use, and the rates that fit."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.wire_time import (
    COMFORTABLE_USE,
    highest_rate,
    line_bytes,
    wire_ns,
    wire_use,
)
from tests.each import each
from tests.vectors.lines import SEED_LINE, WIRE

MS = 1_000_000

TABLE = [
    (baud, count, ms, most)
    for baud, *columns in WIRE
    for count, (ms, most) in zip((33, 36, 41), columns, strict=True)
]

bauds = st.sampled_from([9600, 19200, 38400, 57600, 115200])


@each(("baud", "count", "ms", "most"), TABLE)
def test_the_duration_of_a_line_is_that_of_the_table(
    baud: int, count: int, ms: float, most: int
) -> None:
    assert wire_ns(count, baud) / MS == pytest.approx(ms, rel=0.005)


@each(("baud", "count", "ms", "most"), TABLE)
def test_the_highest_rate_is_the_one_in_the_table(
    baud: int, count: int, ms: float, most: int
) -> None:
    assert highest_rate(baud, count) == most


def test_a_command_has_the_length_of_the_seed_line_in_both_dialects() -> None:
    assert line_bytes(trailing_comma=False) == len(SEED_LINE + b"\r\n") == 33
    assert line_bytes(trailing_comma=True) == len(SEED_LINE + b",\r\n") == 34


def test_the_line_length_is_that_of_the_longer_direction() -> None:
    assert line_bytes(False, check=True) == 41
    assert line_bytes(True, check=True) == 42
    # the reply is longer; the command has 42
    assert line_bytes(False, check=True, sample=True) == 62
    assert line_bytes(True, check=True, sample=True) == 62


def test_100_hz_take_29_percent_of_115200_baud_and_more_than_all_of_9600() -> None:
    # 33 bytes x 10 bits x 100 / 115200 = 0.2865; / 9600 = 3.4375
    assert wire_use(100.0, 115200, 33) == pytest.approx(0.2865, abs=1e-4)
    assert wire_use(100.0, 9600, 33) == 3.4375


def test_23_hz_is_the_highest_comfortable_rate_at_9600_baud() -> None:
    assert highest_rate(9600, 33, COMFORTABLE_USE) == 23  # 0.8 x 9600 / 330 = 23.27


@given(baud=bauds, count=st.integers(1, 128), use=st.floats(0.1, 1.0))
def test_the_highest_rate_fits_and_one_more_does_not(baud: int, count: int, use: float) -> None:
    most = highest_rate(baud, count, use)
    assert wire_use(most, baud, count) <= use * (1 + 1e-12)
    assert wire_use(most + 1, baud, count) > use * (1 - 1e-12)
