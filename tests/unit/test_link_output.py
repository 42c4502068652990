"""What goes to the board: a line at once or not at all, stops in a silence, when they left."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import McuConfig
from acsard.core.link.checked_line import SAMPLE_REQUEST, seal
from acsard.core.link.serial_output import SerialOutput
from acsard.core.values import STILL
from tests.each import each
from tests.unit.link_bench import CHECKED, MS, PLAIN, STOP, LinkBench
from tests.vectors.lines import ZERO

COMMA_STOP = STOP[:-2] + b",\r\n"
GO = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


class Wire:
    """A serial output, and a kernel that accepts only a part of each line."""

    def __init__(self, baud_rate: int = 115200, stop: bytes = STOP, period_ms: int = 10) -> None:
        self.gate, self.stop = SerialOutput(baud_rate, stop, period_ms * MS), stop
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
        assert self.offer(self.stop, 0) == "sent"
        self.out = b""
        return self


@each("line", [GO, seal(STOP, 7)])
def test_an_opening_begins_with_a_line_end_and_the_plain_stop(line: bytes) -> None:
    wire = Wire()
    assert wire.offer(line, 1000, made_ms=100, takes=20) == "superseded"
    wire.out = b""  # after an incomplete one it is sent again
    assert wire.offer(line, 1010) == "superseded"
    assert wire.out == b"\r\n" + STOP
    assert wire.offer(GO, 1020) == "sent"
    assert wire.out == b"\r\n" + STOP + GO


def test_a_line_waits_until_the_previous_one_has_left_wire_and_kernel() -> None:
    wire = Wire(9600)
    wire.offer(STOP, 5)  # 35 bytes at 9600 baud take 36.458 ms
    assert wire.offer(GO, 5 + 36.458) == "superseded"
    assert wire.offer(GO, 5 + 36.459) == "sent"
    for line in (GO, STOP):
        assert wire.offer(line, 1000, kernel=1) == "superseded"
    assert wire.offer(GO, 1000) == "sent"
    # Only the bytes that were taken count: 12 bytes take 12.5 ms.
    wire.offer(GO, 1100, takes=12)
    assert wire.gate.sent_ns == 1100 * MS
    assert wire.offer(GO, 1112.4) == "superseded"
    assert wire.offer(GO, 1112.5, takes=0) == "superseded"
    assert wire.gate.sent_ns == 1100 * MS
    assert wire.offer(GO, 1112.5) == "sent"


@each("period_ms", [4, 10, 100])
def test_a_line_older_than_a_period_is_not_sent(period_ms: int) -> None:
    wire = Wire(period_ms=period_ms).started()
    for line in (GO, seal(GO, 7, SAMPLE_REQUEST), b"ap00.00,bp00.00,cp00.00,dp00.01\r\n"):
        assert wire.offer(line, 100 + period_ms + 0.001, made_ms=100) == "superseded"
    assert wire.offer(GO, 300 + period_ms, made_ms=300) == "sent"


@each("letters", [None, b"", SAMPLE_REQUEST])
@each("stop", [STOP, COMMA_STOP])
def test_a_stop_of_any_form_is_never_too_old(stop: bytes, letters: bytes | None) -> None:
    line = stop if letters is None else seal(stop, 7, letters)
    wire = Wire(stop=stop).started()
    assert wire.offer(line, 1000, made_ms=100) == "sent"
    assert wire.out == line


@settings(max_examples=100)
@given(
    baud=st.sampled_from([9600, 19200, 38400, 57600, 115200, 250000, 500000]),
    sends=st.lists(st.tuples(st.integers(0, 50 * MS), st.integers(0, 35)), min_size=1),
)
def test_no_bytes_ever_queue_on_the_wire(baud: int, sends: list[tuple[int, int]]) -> None:
    gate, now_ns, busy_until_ns = SerialOutput(baud, STOP, 10 * MS), 0, 0
    for pause_ns, takes in sends:
        now_ns += pause_ns
        data = gate.prepare(GO, now_ns, now_ns, 0)
        if data is not None:
            assert now_ns >= busy_until_ns
            size = min(takes, len(data))
            gate.record_write(GO, data, size, now_ns)
            busy_until_ns = now_ns + size * 10 * 1_000_000_000 // baud


# which line is made


@each("mcu", [PLAIN, CHECKED])
def test_a_session_begins_with_a_plain_stop_and_the_question_follows_the_first_line(
    mcu: McuConfig,
) -> None:
    bench = LinkBench(mcu).open()
    bench.wait(10)
    lines = [bench.line()]
    for _ in range(50):
        bench.wait(10)
        lines.append(bench.line())
    assert set(lines) <= {None, STOP, *[seal(ZERO, n) for n in range(9)]}
    assert lines[0] == STOP
    bench.wait(10, STOP)
    assert bench.line() == b"?\r\n"
    bench.update(False)
    assert bench.line() == b"?\r\n"  # until it has left
    bench.update(True)
    assert bench.line() != b"?\r\n"


# when rest was commanded


def test_a_silent_board_gets_a_stop_without_delay_and_then_ten_a_second() -> None:
    bench = LinkBench().up()
    assert bench.line(STILL) == STOP
    while not bench.session.silent(bench.now_ns):
        assert bench.line() == b"ap01.00,bp01.00,cp01.00,dp01.00\r\n"
        bench.wait(10)
    assert bench.line() == STOP
    lines = []
    for _ in range(100):
        bench.wait(10)
        lines.append(bench.line())
    assert [line for line in lines if line] == [STOP] * 10
    # A board that reports by its own clock gets no more time behind a late step: its lines would
    # wait in the kernel.
    free = LinkBench(McuConfig(reply_period=0.02)).up()
    free.wait(150)
    assert free.link == "stale"
