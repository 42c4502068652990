"""The fake microcontroller against an independent model of its firmware, and each of its faults.

`TRUE` has no motor lag and fine encoders, so it reports exactly the commanded speeds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from itertools import pairwise
from operator import methodcaller
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.named_faults import FAULTS
from acsard.core.config.settings import Config, McuConfig, SimConfig
from acsard.core.simulator.fake_mcu import MS, RESET_NS, FakeMcu
from tests.each import each

LINE = b"ap12.50,bn08.75,cp15.00,dn10.25\r\n"
SPEEDS = [12.5, -8.75, 15.0, -10.25]
ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
STILL = [0.0] * 4
SEALED = LINE[:-2] + b"#07S*EE6B\r\n"
LINE_NS = 33 * 10 * 1_000_000_000 // 115200  # on the wire: 2.86 ms

TRUE = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=1_000_000))

Heard = list[tuple[int, bytes]]


def replies(mcu: FakeMcu, until_ns: int) -> Heard:
    """Advance the board from event to event, and return the data that it sent, with times."""
    chunks = []
    while (due := mcu.next_ns()) is not None and due <= until_ns:
        if data := mcu.advance(due):
            chunks.append((due, data))
    assert mcu.advance(until_ns) == b""
    return chunks


def drive(mcu: FakeMcu, start_ns: int, count: int, line: bytes = LINE) -> Heard:
    """Send a line every 10 ms, `count` times, and listen for 10 ms after the last one."""
    chunks = []
    for n in range(count):
        mcu.receive(start_ns + n * 10 * MS, line)
        chunks += replies(mcu, start_ns + (n + 1) * 10 * MS)
    return chunks


def joined(chunks: Heard) -> bytes:
    return b"".join(data for _, data in chunks)


# The board and an independent model of it.

TOKENS = b",".join(b"%c([pn])(\\d\\d\\.\\d\\d)" % motor for motor in b"abcd")
WHOLE = re.compile(TOKENS + rb",?\r?\n")


class Model:
    """Obeys the last whole line for 300 ms."""

    def __init__(self) -> None:
        self.speeds, self.until_ms, self.valid = STILL, -1.0, 0

    def hears(self, line: bytes, ends_ms: float) -> None:
        if found := WHOLE.fullmatch(line):
            signs, values = found.groups()[0::2], found.groups()[1::2]
            self.speeds = [
                float(v) * (1 if s == b"p" else -1) for s, v in zip(signs, values, strict=True)
            ]
            self.until_ms, self.valid = ends_ms + 300, self.valid + 1


speed = st.tuples(st.sampled_from("pn"), st.integers(0, 9999)).map(
    lambda value: f"{value[0]}{value[1] / 100:05.2f}"
)
whole = st.tuples(speed, speed, speed, speed, st.sampled_from(["\r\n", "\n", ",\r\n"])).map(
    lambda of: ("a{},b{},c{},d{}{}".format(*of)).encode()
)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """Return a line in which up to two places are lost, doubled or replaced."""
    line = draw(whole)[:-1]
    for _ in range(draw(st.integers(1, 2))):
        at = draw(st.integers(0, len(line) - 1))
        others = st.sampled_from([b"", b"x", b" ", b",", b"\x00", b"\xff", b"-", b"9", b"ap1"])
        line = line[:at] + draw(others) + line[at + draw(st.integers(0, 1)) :]
    return line + b"\n"


@given(st.lists(st.tuples(st.sampled_from([20, 60, 280, 330, 900]), whole | damaged()), max_size=9))
def test_the_board_obeys_and_answers_whole_lines_only_and_forgets_them_after_300_ms(
    sent: list[tuple[int, bytes]],
) -> None:
    mcu, model, now = FakeMcu(TRUE), Model(), 0
    answers = 0
    for wait_ms, line in sent:
        mcu.receive(now * MS, line)
        model.hears(line, now + len(line) * 10e3 / 115200)
        answers += len(replies(mcu, (now + 15) * MS))  # on the wire, and 1 to 5 ms later
        assert mcu.vehicle.set_points == pytest.approx(model.speeds)
        now += wait_ms
        answers += len(replies(mcu, now * MS))
        if now > model.until_ms + 5:
            model.speeds = STILL
        assert mcu.vehicle.set_points == pytest.approx(model.speeds)
    assert [line for _, line in mcu.heard] == [line for _, line in sent]
    assert mcu.valid_lines == answers == model.valid


@each("cut", range(1, 33))
def test_a_line_in_two_pieces_is_one_line(cut: int) -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE[:cut])
    mcu.advance(20 * MS)
    assert mcu.vehicle.set_points == STILL
    mcu.receive(20 * MS, LINE[cut:])
    mcu.advance(60 * MS)
    assert mcu.vehicle.set_points == SPEEDS
    assert [line for _, line in mcu.heard] == [LINE]


def test_the_board_starts_silent_and_then_reports_its_speeds_in_the_form_of_the_line() -> None:
    mcu = FakeMcu(TRUE)
    assert replies(mcu, 1000 * MS) == []
    assert mcu.next_ns() is None
    assert [data for _, data in drive(mcu, 1000 * MS, 6)] == [ZERO] + [LINE] * 5
    assert drive(FakeMcu(TRUE), 0, 5, b"an00.00,bp00.10,cp99.99,dn99.99\n")[-1][1] == (
        b"ap00.00,bp00.10,cp99.99,dn99.99\r\n"
    )


def test_coarse_encoders_count_whole_steps_and_motors_lag() -> None:
    coarse = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=16))
    speeds = {data[2:7] for _, data in drive(FakeMcu(coarse), 0, 50)}
    assert b"00.00" in speeds
    assert b"12.50" not in speeds
    slow = Config(sim=SimConfig(motor_time_constant=0.05, encoder_counts=1_000_000))
    rising = [float(data[2:7]) for _, data in drive(FakeMcu(slow), 0, 60)]
    assert rising == sorted(rising)
    assert rising[2] < 0.6 * 12.5
    assert rising[-1] == 12.5


def test_two_reads_of_the_encoders_within_4_ms_give_the_same_figures() -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 4)
    mcu.receive(50 * MS, b"ap01.00,bp01.00,cp01.00,dp01.00\r\n" + ZERO)
    assert [data for _, data in replies(mcu, 80 * MS)] == [LINE] * 2
    mcu.receive(80 * MS, ZERO)
    assert replies(mcu, 100 * MS)[0][1] != LINE


# Time.


@pytest.mark.parametrize(("baud", "line_ns"), [(9600, 34_375_000), (115200, 2_864_583)])
def test_lines_and_answers_take_their_time_on_the_wire_one_after_the_other(
    baud: Any, line_ns: int
) -> None:
    mcu = FakeMcu(replace(TRUE, mcu=McuConfig(baud_rate=baud)))
    mcu.receive(1000, LINE)
    mcu.receive(1000, LINE * 7)
    sent = [when for when, _ in replies(mcu, 2000 * MS)]
    assert [at for at, _ in mcu.heard] == pytest.approx(
        [1000 + n * line_ns for n in range(1, 9)], abs=8
    )
    assert 1 * MS <= sent[0] - 1000 - 2 * line_ns <= 5 * MS
    assert len(sent) == 8
    assert all(later - sooner >= line_ns - 1 for sooner, later in pairwise(sent))


def test_processing_takes_a_varying_time_of_one_to_five_milliseconds() -> None:
    chunks = drive(FakeMcu(TRUE), 0, 40)
    delays = [when - n * 10 * MS - 2 * LINE_NS for n, (when, _) in enumerate(chunks)]
    assert len(chunks) >= 39
    assert 1 * MS - 10 <= min(delays) < max(delays) - 2 * MS
    assert max(delays) <= 5 * MS + 10


def test_the_output_does_not_depend_on_how_often_the_board_is_advanced() -> None:
    busy, lazy = FakeMcu(TRUE), FakeMcu(TRUE)
    for mcu in (busy, lazy):
        mcu.receive(0, LINE * 3)
    in_steps = b"".join(busy.advance(n * 100_000) for n in range(1000))
    assert in_steps == lazy.advance(99_900_000)
    assert busy.vehicle.angles == pytest.approx(lazy.vehicle.angles)


def test_the_watchdog_stops_the_motors_exactly_300_ms_after_the_line_took_effect() -> None:
    mcu, now_ns = FakeMcu(TRUE), 0
    mcu.receive(0, LINE)
    while not any(mcu.vehicle.set_points):
        now_ns = mcu.next_ns() or 0
        mcu.advance(now_ns)
    mcu.advance(now_ns + 300 * MS - 1)
    assert mcu.vehicle.set_points == SPEEDS
    mcu.advance(now_ns + 60_000 * MS)  # late
    assert mcu.vehicle.angles == pytest.approx([speed * 0.3 for speed in SPEEDS])
    assert mcu.watchdog_trips == 1
    mcu.receive(now_ns + 60_000 * MS, ZERO)
    mcu.advance(now_ns + 90_000 * MS)
    assert mcu.watchdog_trips == 1  # at rest it does not trip


def test_a_reset_stops_the_motors_discards_the_wire_and_prints_noise() -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 4)
    mcu.receive(40 * MS, LINE + LINE[:10])
    mcu.reset(41 * MS)
    assert mcu.vehicle.set_points == STILL
    noise = joined(drive(mcu, 50 * MS, (RESET_NS - 20 * MS) // (10 * MS)))
    assert noise.endswith(b"\n")
    assert b"ap" not in noise
    assert mcu.vehicle.set_points == STILL


@pytest.mark.parametrize(("early_ns", "speeds"), [(1, STILL), (0, SPEEDS)])
def test_a_line_is_obeyed_from_the_exact_end_of_the_reset(
    early_ns: int, speeds: list[float]
) -> None:
    mcu = FakeMcu(TRUE)
    mcu.reset(0)
    mcu.receive(RESET_NS - LINE_NS - early_ns, LINE)
    mcu.advance(RESET_NS + 20 * MS)
    assert mcu.vehicle.set_points == speeds


# Faults.

Fault = Callable[[FakeMcu], AbstractContextManager[None]]

NAMED: Mapping[str, Fault] = {name: methodcaller(name) for name in FAULTS} | {
    "bias": methodcaller("bias", 2, 1.5), "stuck_encoder": methodcaller("stuck_encoder", 1),
    "frozen_encoder": methodcaller("frozen_encoder", 2),
}  # fmt: skip


def story(mcu: FakeMcu, start_ns: int) -> tuple[Heard, list[float], list[float]]:
    """Drive for half a second, then send only one invalid line."""
    chunks = drive(mcu, start_ns, 40) + drive(mcu, start_ns + 400 * MS, 10, SEALED)
    chunks += replies(mcu, start_ns + 650 * MS)
    mcu.receive(start_ns + 650 * MS, b"ap0\r\n")
    chunks += replies(mcu, start_ns + 1000 * MS)
    at = [(when - start_ns, data) for when, data in chunks]
    return at, list(mcu.vehicle.angles), list(mcu.vehicle.set_points)


@each("fault", NAMED.values())
def test_a_fault_changes_the_behaviour_and_ends_with_its_block(fault: Fault) -> None:
    faulty, sound, mended = FakeMcu(TRUE), FakeMcu(TRUE), FakeMcu(TRUE)
    with fault(faulty):
        assert story(faulty, 0) != story(FakeMcu(TRUE), 0)
    with suppress(KeyError), fault(mended):
        drive(mended, 0, 4, ZERO)
        replies(mended, 250 * MS)
        raise KeyError
    drive(sound, 0, 4, ZERO)
    replies(sound, 250 * MS)
    assert story(mended, 250 * MS) == story(sound, 250 * MS)


@each(
    ("faults", "reply"),
    [
        ([("spaces",), ("trailing_comma",), ("noise", b"~")],
         b"~ap12.50, bn08.75, cp15.00, dn10.25,\r\n"),
        ([("noise", b"\x00\xff~")], b"\x00\xff~" + LINE),
        ([("partial_line",)], LINE[:16]),
        ([("bias", 0, 0.0), ("bias", 2, 0.5)], b"ap00.00,bn08.75,cp07.50,dn10.25\r\n"),
        ([("stuck_encoder", 1)], b"ap12.50,bp00.00,cp15.00,dn10.25\r\n"),
        ([("swapped_encoders", 0, 1), ("reversed_encoder", 0)],
         b"an08.75,bn12.50,cp15.00,dn10.25\r\n"),
        ([("mute",)], None),
        ([("lost_replies", 1)], None),
    ],
)  # fmt: skip
def test_a_fault_of_the_report_does_not_change_the_motion(
    faults: list[tuple[Any, ...]], reply: bytes | None
) -> None:
    mcu = FakeMcu(TRUE)
    with ExitStack() as on:
        for name, *arguments in faults:
            on.enter_context(getattr(mcu, name)(*arguments))
        chunks = drive(mcu, 0, 6)
    assert [data for _, data in chunks[-1:]] == ([] if reply is None else [reply])
    assert mcu.vehicle.set_points == SPEEDS
    assert mcu.valid_lines == 6


def test_a_frozen_encoder_keeps_its_last_speed_while_its_wheel_stops() -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 5)
    with mcu.frozen_encoder(2):
        assert drive(mcu, 50 * MS, 5, ZERO)[-1][1] == b"ap00.00,bp00.00,cp15.00,dp00.00\r\n"
    assert mcu.vehicle.speeds == STILL


def test_a_muted_board_still_identifies_itself() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.mute():
        mcu.receive(0, b"?\r\n")
        assert joined(replies(mcu, 20 * MS)).startswith(b"!acsard-mcu ")


@pytest.mark.parametrize(("fault", "every"), [("lost_commands", 2), ("bit_errors", 1)])
def test_a_command_that_a_fault_takes_is_recorded_too(fault: str, every: int) -> None:
    mcu = FakeMcu(TRUE)
    with getattr(mcu, fault)(every=every):
        mcu.receive(0, LINE * 2)
        mcu.advance(20 * MS)
    assert mcu.valid_lines == 1
    assert len(mcu.heard) == 2


@pytest.mark.parametrize(
    ("fault", "fed", "drives_s"), [("no_watchdog", b"", 60), ("watchdog_fed_by_bad_lines", b"x", 0)]
)
def test_a_faulty_watchdog_lets_the_motors_run_on(fault: str, fed: bytes, drives_s: int) -> None:
    mcu = FakeMcu(TRUE)
    with getattr(mcu, fault)():
        mcu.receive(0, LINE)
        for n in range(1, 10):
            mcu.receive(n * 100 * MS, fed and b"x\r\n")
            mcu.advance((n * 100 + 50) * MS)
            assert mcu.vehicle.set_points == SPEEDS
        mcu.advance(60_000 * MS)
        assert any(mcu.vehicle.set_points) is bool(drives_s)


def test_a_slow_board_acts_and_answers_later_by_its_delay() -> None:
    (prompt,) = drive(FakeMcu(TRUE), 0, 1)
    mcu = FakeMcu(TRUE)
    with mcu.slow_reply(0.03):
        mcu.receive(0, LINE)
        mcu.advance(LINE_NS + 31 * MS)
        assert mcu.vehicle.set_points == STILL
        ((late, _),) = replies(mcu, 100 * MS)
    assert late == prompt[0] + 30 * MS


def test_replies_longer_than_the_commands_are_lost_once_the_output_buffer_is_full() -> None:
    mcu, count = FakeMcu(TRUE), 1000
    with mcu.spaces():
        mcu.receive(0, LINE * count)
        chunks = replies(mcu, 10_000 * MS)
    assert count * 0.85 < len(chunks) < count * 0.95
    assert chunks[-1][0] < count * LINE_NS + 30 * MS
    assert {len(line) for _, line in chunks} == {len(LINE) + 3}


@pytest.mark.parametrize(
    ("fault", "front"), [("dead_motor", [0.0, 12.5]), ("reversed_motor", [8.75, 12.5])]
)
def test_a_motor_whose_wires_are_swapped_keeps_its_own_fault(
    fault: str, front: list[float]
) -> None:
    mcu = FakeMcu(TRUE)
    with mcu.swapped_motors(0, 1), getattr(mcu, fault)(0):
        drive(mcu, 0, 2)
        assert mcu.vehicle.set_points == [*front, *SPEEDS[2:]]


@each(
    ("line", "set_points"),
    [
        (LINE, [12.5, -8.75, 15.0, 0.0]),
        (LINE[:-2] + b",\r\n", SPEEDS),
        (b"ap12.50,bx08.75,cp1?.00,dn10.25,\r\n", [12.5, 0.0, 0.0, -10.25]),
        (b"apnan,bp01.00,cp01.00,dp01.00,\r\n", [0.0, 1.0, 1.0, 1.0]),
    ],
)
def test_a_comma_latched_board_takes_each_wheel_at_its_comma(
    line: bytes, set_points: list[float]
) -> None:
    mcu = FakeMcu(TRUE)
    with mcu.comma_latched():
        drive(mcu, 0, 1, line)
        assert mcu.vehicle.set_points == set_points


def test_a_free_running_board_reports_by_its_own_clock_unpadded_and_with_a_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.1):
        chunks = drive(mcu, 0, 40, b"ap02.50,bn08.75,cp15.00,dp00.00\r\n")
        assert {data for _, data in chunks[1:]} == {b"ap2.50,bn8.75,cp15.00,dp0.00,\r\n"}
        assert [b[0] - a[0] for a, b in pairwise(chunks)] == [100 * MS] * 2
        mcu.reset(400 * MS)
        assert b"," not in mcu.advance(400 * MS + RESET_NS)
    with mcu.free_running(0.1):  # entered twice, it is not twice as fast
        assert 9 <= mcu.advance(1400 * MS + RESET_NS).count(b"ap0.00") <= 10


def arrivals(mcu: FakeMcu) -> Heard:
    """Return what the host reads each ms from a board that is prompted every 10 ms for 1 s."""
    chunks = []
    for ms in range(1200):
        if ms % 10 == 0 and ms < 1000:
            mcu.receive(ms * MS, LINE)
        if data := mcu.advance(ms * MS):
            chunks.append((ms, data))
    return chunks


@pytest.mark.parametrize(
    ("ftdi_ms", "stall"), [(16, None), (100, None), (0, (0.5, 0.15)), (16, (0.3, 0.1))]
)
def test_an_adapter_and_stalls_delay_the_data_and_lose_none(
    ftdi_ms: int, stall: tuple[float, float] | None
) -> None:
    mcu = FakeMcu(TRUE)
    with ExitStack() as on:
        if ftdi_ms:
            on.enter_context(mcu.ftdi(latency_s=ftdi_ms / 1000))
        if stall:
            on.enter_context(mcu.stalls(*stall))
        chunks = arrivals(mcu)
    assert joined(chunks) == joined(arrivals(FakeMcu(TRUE)))
    assert any(len(data) > len(LINE) for _, data in chunks)
    if stall:
        every, lasts = (round(1000 * s) for s in stall)
        assert not [ms for ms, _ in chunks if ms % every < lasts]
    else:
        # A full packet of the adapter does not wait.
        assert {len(data) for ms, data in chunks if ms % ftdi_ms} <= {62}
