"""Wire time, wire use, and the gate that never keeps a line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.mcu.wire import (
    COMFORTABLE_USE,
    LineGate,
    highest_rate,
    line_bytes,
    wire_ns,
    wire_use,
)
from tests.vectors.lines import SEED_LINE, WIRE

MS = 1_000_000

TABLE = [
    (baud, count, ms, most)
    for baud, *columns in WIRE
    for count, (ms, most) in zip((33, 36, 41), columns, strict=True)
]

bauds = st.sampled_from([9600, 19200, 38400, 57600, 115200])


@pytest.mark.parametrize(("baud", "count", "ms", "most"), TABLE)
def test_a_line_takes_as_long_as_the_table_says(
    baud: int, count: int, ms: float, most: int
) -> None:
    assert wire_ns(count, baud) / MS == pytest.approx(ms, rel=0.005)


@pytest.mark.parametrize(("baud", "count", "ms", "most"), TABLE)
def test_the_highest_rate_is_the_one_in_the_table(
    baud: int, count: int, ms: float, most: int
) -> None:
    assert highest_rate(baud, count) == most


def test_a_command_is_as_long_as_the_seed_line_in_either_dialect() -> None:
    assert line_bytes(trailing_comma=False) == len(SEED_LINE + b"\r\n") == 33
    assert line_bytes(trailing_comma=True) == len(SEED_LINE + b",\r\n") == 34


def test_the_longest_line_of_either_direction_is_what_counts() -> None:
    assert line_bytes(False, check=True) == 41
    assert line_bytes(True, check=True) == 42
    assert line_bytes(False, check=True, sample=True) == 62  # the reply; the command has 42
    assert line_bytes(True, check=True, sample=True) == 62


def test_100_hz_take_29_percent_of_115200_baud_and_more_than_all_of_9600() -> None:
    # 33 bytes x 10 bits x 100 / 115200 = 0.2865; / 9600 = 3.4375
    assert wire_use(100.0, 115200, 33) == pytest.approx(0.2865, abs=1e-4)
    assert wire_use(100.0, 9600, 33) == 3.4375


def test_23_hz_are_comfortable_at_9600_baud() -> None:
    assert highest_rate(9600, 33, COMFORTABLE_USE) == 23  # 0.8 x 9600 / 330 = 23.27


@given(baud=bauds, count=st.integers(1, 128), use=st.floats(0.1, 1.0))
def test_the_highest_rate_fits_and_one_more_does_not(baud: int, count: int, use: float) -> None:
    most = highest_rate(baud, count, use)
    assert wire_use(most, baud, count) <= use * (1 + 1e-12)
    assert wire_use(most + 1, baud, count) > use * (1 - 1e-12)


def test_a_new_gate_lets_a_line_go_behind_an_end_of_line() -> None:
    gate = LineGate(115200)
    assert gate.may_send(0, 0)
    assert gate.prefix == b"\r\n"


def test_a_line_waits_until_the_one_before_has_left_the_wire() -> None:
    gate = LineGate(9600)
    gate.note_sent(5 * MS, 33, 33)  # 33 bytes at 9600 baud: 34.375 ms
    assert not gate.may_send(5 * MS + 34_374_999, 0)
    assert gate.may_send(5 * MS + 34_375_000, 0)


def test_no_line_goes_while_the_kernel_holds_a_byte() -> None:
    gate = LineGate(115200)
    assert not gate.may_send(10**12, 1)
    assert gate.may_send(10**12, 0)


def test_after_a_whole_line_the_next_one_needs_no_prefix() -> None:
    gate = LineGate(115200)
    gate.note_sent(0, 35, 35)
    assert gate.prefix == b""


def test_after_a_torn_line_the_next_one_begins_with_an_end_of_line() -> None:
    gate = LineGate(115200)
    gate.note_sent(0, 35, 35)
    gate.note_sent(10 * MS, 33, 32)
    assert gate.prefix == b"\r\n"


def test_a_line_the_kernel_took_nothing_of_leaves_the_prefix_as_it_was() -> None:
    gate = LineGate(115200)
    gate.note_sent(0, 35, 0)
    assert gate.prefix == b"\r\n"
    gate.note_sent(0, 35, 35)
    gate.note_sent(10 * MS, 33, 0)
    assert gate.prefix == b""


def test_only_the_bytes_that_were_taken_occupy_the_wire() -> None:
    gate = LineGate(9600)
    gate.note_sent(0, 33, 12)  # 12 bytes at 9600 baud: 12.5 ms
    assert not gate.may_send(12_499_999, 0)
    assert gate.may_send(12_500_000, 0)


@given(
    baud=bauds,
    sends=st.lists(st.tuples(st.integers(0, 50 * MS), st.integers(0, 35)), min_size=1),
)
def test_the_gate_never_lets_bytes_queue_on_the_wire(
    baud: int, sends: list[tuple[int, int]]
) -> None:
    gate, now_ns, busy_until_ns = LineGate(baud), 0, 0
    for pause_ns, taken in sends:
        now_ns += pause_ns
        if gate.may_send(now_ns, 0):
            assert now_ns >= busy_until_ns
            gate.note_sent(now_ns, 35, taken)
            busy_until_ns = now_ns + taken * 10 * 1_000_000_000 // baud
