"""The gate that never keeps a line."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acsard.mcu.wire import LineGate

MS = 1_000_000

bauds = st.sampled_from([9600, 19200, 38400, 57600, 115200])


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
