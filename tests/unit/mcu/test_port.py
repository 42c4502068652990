"""The gate that never keeps a line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.mcu.port import STALE_NS, Gate

MS = 1_000_000
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
GO = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


class Wire:
    """A gate and a kernel that takes what it is handed."""

    def __init__(self, baud_rate: int = 115200) -> None:
        self.gate = Gate(baud_rate, STOP)
        self.out = b""

    def offer(
        self,
        line: bytes,
        at_ms: float,
        made_ms: float | None = None,
        kernel: int = 0,
        takes: int = 99,
    ) -> str:
        now_ns, made_ns = int(at_ms * MS), int((at_ms if made_ms is None else made_ms) * MS)
        data = self.gate.prepare(line, made_ns, now_ns, kernel)
        if data is None:
            return "superseded"
        taken = min(takes, len(data))
        self.out += data[:taken]
        return self.gate.took(line, data, taken, now_ns)

    def started(self) -> Wire:
        assert self.offer(STOP, 0) == "sent"
        self.out = b""
        return self


def test_the_first_line_of_an_opening_is_a_stop_behind_an_end_of_line() -> None:
    wire = Wire()
    assert wire.offer(GO, 0) == "superseded"
    assert wire.out == b"\r\n" + STOP
    assert wire.offer(GO, 10) == "sent"
    assert wire.out == b"\r\n" + STOP + GO


def test_a_first_line_that_did_not_go_whole_leaves_the_next_one_the_first() -> None:
    wire = Wire()
    assert wire.offer(GO, 0, takes=20) == "superseded"
    assert wire.offer(GO, 10) == "superseded"
    assert wire.out.endswith(b"\r\n" + STOP)


def test_a_line_waits_until_the_one_before_has_left_the_wire() -> None:
    wire = Wire(9600)
    wire.offer(STOP, 5)  # 35 bytes at 9600 baud: 36.458 ms
    assert wire.offer(GO, 5 + 36.458) == "superseded"
    assert wire.offer(GO, 5 + 36.459) == "sent"


def test_no_line_goes_while_the_kernel_holds_a_byte() -> None:
    wire = Wire().started()
    assert wire.offer(GO, 1000, kernel=1) == "superseded"
    assert wire.offer(STOP, 1000, kernel=1) == "superseded"
    assert wire.offer(GO, 1000) == "sent"


def test_what_was_made_before_a_standstill_does_not_go_after_it_but_a_stop_does() -> None:
    wire = Wire().started()
    stale_ms = STALE_NS / MS
    assert wire.offer(GO, 100 + stale_ms + 0.001, made_ms=100) == "superseded"
    assert wire.offer(STOP, 100 + stale_ms + 0.001, made_ms=100) == "sent"
    assert wire.offer(GO, 200 + stale_ms, made_ms=200) == "sent"


@pytest.mark.parametrize(("takes", "prefix"), [(33, b""), (32, b"\r\n"), (0, b"")])
def test_only_after_a_torn_line_the_next_one_begins_with_an_end_of_line(
    takes: int, prefix: bytes
) -> None:
    wire = Wire().started()
    assert wire.offer(GO, 10, takes=takes) == ("sent" if takes == 33 else "superseded")
    wire.out = b""
    assert wire.offer(GO, 20) == "sent"
    assert wire.out == prefix + GO


def test_only_the_bytes_that_were_taken_occupy_the_wire_and_count_as_sent() -> None:
    wire = Wire(9600).started()
    wire.offer(GO, 100, takes=12)  # 12 bytes at 9600 baud: 12.5 ms
    assert wire.gate.sent_ns == 100 * MS
    assert wire.offer(GO, 112.4) == "superseded"
    assert wire.offer(GO, 112.5, takes=0) == "superseded"
    assert wire.gate.sent_ns == 100 * MS
    assert wire.offer(GO, 112.5) == "sent"


@given(
    baud=st.sampled_from([9600, 19200, 38400, 57600, 115200]),
    sends=st.lists(st.tuples(st.integers(0, 50 * MS), st.integers(0, 35)), min_size=1),
)
def test_the_gate_never_lets_bytes_queue_on_the_wire(
    baud: int, sends: list[tuple[int, int]]
) -> None:
    gate, now_ns, busy_until_ns = Gate(baud, STOP), 0, 0
    for pause_ns, takes in sends:
        now_ns += pause_ns
        data = gate.prepare(GO, now_ns, now_ns, 0)
        if data is not None:
            assert now_ns >= busy_until_ns
            taken = min(takes, len(data))
            gate.took(GO, data, taken, now_ns)
            busy_until_ns = now_ns + taken * 10 * 1_000_000_000 // baud
