"""Tests of the serial output, which sends or drops each line at once and queues none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.checked_line import SAMPLE_REQUEST, seal
from acsard.core.link.serial_output import SerialOutput
from tests.each import each

MS = 1_000_000
PERIOD_NS = 10 * MS
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
COMMA_STOP = b"ap00.00,bp00.00,cp00.00,dp00.00,\r\n"
GO = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


class Wire:
    """A serial output, and a kernel that accepts only a part of each line."""

    def __init__(self, baud_rate: int = 115200, stop: bytes = STOP, period_ms: int = 10) -> None:
        self.gate = SerialOutput(baud_rate, stop, period_ms * MS)
        self._stop = stop
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
        size = min(takes, len(data))
        self.out += data[:size]
        return self.gate.record_write(line, data, size, now_ns)

    def started(self) -> Wire:
        assert self.offer(self._stop, 0) == "sent"
        self.out = b""
        return self


def test_the_first_line_after_an_opening_is_a_line_end_and_a_stop() -> None:
    wire = Wire()
    assert wire.offer(GO, 0) == "superseded"
    assert wire.out == b"\r\n" + STOP
    assert wire.offer(GO, 10) == "sent"
    assert wire.out == b"\r\n" + STOP + GO


def test_after_an_incomplete_first_line_the_next_line_is_again_the_opening_stop() -> None:
    wire = Wire()
    assert wire.offer(GO, 0, takes=20) == "superseded"
    assert wire.offer(GO, 10) == "superseded"
    assert wire.out.endswith(b"\r\n" + STOP)


def test_a_line_waits_until_the_previous_line_has_left_the_wire() -> None:
    wire = Wire(9600)
    wire.offer(STOP, 5)  # 35 bytes at 9600 baud take 36.458 ms
    assert wire.offer(GO, 5 + 36.458) == "superseded"
    assert wire.offer(GO, 5 + 36.459) == "sent"


def test_no_line_is_sent_while_the_kernel_holds_a_byte() -> None:
    wire = Wire().started()
    assert wire.offer(GO, 1000, kernel=1) == "superseded"
    assert wire.offer(STOP, 1000, kernel=1) == "superseded"
    assert wire.offer(GO, 1000) == "sent"


@pytest.mark.parametrize("period_ms", [4, 10, 100])
def test_a_line_older_than_a_period_is_not_sent(period_ms: int) -> None:
    wire = Wire(period_ms=period_ms).started()
    assert wire.offer(GO, 100 + period_ms + 0.001, made_ms=100) == "superseded"
    assert wire.offer(GO, 300 + period_ms, made_ms=300) == "sent"


@each("letters", [None, b"", SAMPLE_REQUEST])
@each("stop", [STOP, COMMA_STOP])
def test_a_stop_of_any_form_is_never_too_old(stop: bytes, letters: bytes | None) -> None:
    line = stop if letters is None else seal(stop, 7, letters)
    wire = Wire(stop=stop).started()
    assert wire.offer(line, 1000, made_ms=100) == "sent"
    assert wire.out == line


@pytest.mark.parametrize(
    "line", [GO, seal(GO, 7), b"ap00.00,bp00.00,cp00.00,dp00.01\r\n", seal(GO, 7, SAMPLE_REQUEST)]
)
def test_a_line_that_turns_a_wheel_is_not_a_stop(line: bytes) -> None:
    assert Wire().started().offer(line, 1000, made_ms=100) == "superseded"


def test_the_opening_stop_is_sent_even_if_the_requested_line_is_too_old() -> None:
    wire = Wire()
    assert wire.offer(GO, 1000, made_ms=100) == "superseded"
    assert wire.out == b"\r\n" + STOP


def test_the_opening_stop_is_the_plain_one_that_every_board_obeys() -> None:
    wire = Wire()
    assert wire.offer(seal(STOP, 7), 0) == "superseded"
    assert wire.out == b"\r\n" + STOP


@pytest.mark.parametrize(("takes", "prefix"), [(33, b""), (32, b"\r\n"), (0, b"")])
def test_a_line_begins_with_a_line_end_only_after_a_torn_line(takes: int, prefix: bytes) -> None:
    wire = Wire().started()
    assert wire.offer(GO, 10, takes=takes) == ("sent" if takes == 33 else "superseded")
    wire.out = b""
    assert wire.offer(GO, 20) == "sent"
    assert wire.out == prefix + GO


def test_only_the_bytes_that_were_taken_occupy_the_wire_and_count_as_sent() -> None:
    wire = Wire(9600).started()
    wire.offer(GO, 100, takes=12)  # 12 bytes at 9600 baud take 12.5 ms
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
    gate, now_ns, busy_until_ns = SerialOutput(baud, STOP, PERIOD_NS), 0, 0
    for pause_ns, takes in sends:
        now_ns += pause_ns
        data = gate.prepare(GO, now_ns, now_ns, 0)
        if data is not None:
            assert now_ns >= busy_until_ns
            size = min(takes, len(data))
            gate.record_write(GO, data, size, now_ns)
            busy_until_ns = now_ns + size * 10 * 1_000_000_000 // baud
