"""Tests of the protocol of the fake microcontroller, exact to the byte and the nanosecond.

`TRUE` has no motor lag and fine encoders, so that it reports exactly the commanded speeds.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from operator import methodcaller
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.config.named_faults import FAULTS
from acsard.core.config.settings import Config, McuConfig, SimConfig
from acsard.core.simulator.fake_mcu import MS, RESET_NS, FakeMcu
from tests.each import each

LINE = b"ap12.50,bn08.75,cp15.00,dn10.25\r\n"
SPEEDS = [12.5, -8.75, 15.0, -10.25]
ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
STILL = [0.0] * 4

TRUE = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=1_000_000))

LINE_NS = 33 * 10 * 1_000_000_000 // 115200
"""Duration of one line on the wire; this is 2.86 ms."""

Heard = list[tuple[int, bytes]]


def replies(mcu: FakeMcu, until_ns: int) -> Heard:
    """Advance the MCU from event to event, and return the data that it sent, with times."""
    chunks = []
    while (due := mcu.next_ns()) is not None and due <= until_ns:
        data = mcu.advance(due)
        if data:
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


def mcu_after_line(line: bytes, config: Config = TRUE) -> FakeMcu:
    """Return an MCU that received this line once, after enough time to act on it."""
    mcu = FakeMcu(config)
    mcu.receive(0, line)
    mcu.advance(100 * MS)
    return mcu


def at_baud(baud: Any) -> Config:
    return replace(TRUE, mcu=McuConfig(baud_rate=baud))


# answers


def test_the_mcu_boots_stopped_and_sends_nothing_unprompted() -> None:
    mcu = FakeMcu(TRUE)
    assert replies(mcu, 1000 * MS) == []
    assert mcu.vehicle.set_points == STILL
    assert mcu.next_ns() is None


def test_the_mcu_answers_a_line_with_its_speeds_in_the_same_format() -> None:
    mcu = FakeMcu(TRUE)
    assert drive(mcu, 0, 1)[0][1] == ZERO
    assert [data for _, data in drive(mcu, 10 * MS, 5)] == [LINE] * 5


@each(
    ("sent", "answered"),
    [
        (b"ap00.00,bp00.00,cp00.00,dp00.00\r\n", ZERO),
        (b"ap99.99,bn99.99,cp99.99,dn99.99\r\n", b"ap99.99,bn99.99,cp99.99,dn99.99\r\n"),
        (b"ap01.00,bp02.00,cp03.00,dp04.00\r\n", b"ap01.00,bp02.00,cp03.00,dp04.00\r\n"),
        (b"an00.10,bp00.00,cn00.10,dp00.10\n", b"an00.10,bp00.00,cn00.10,dp00.10\r\n"),
        (b"ap01.00,bp02.00,cp03.00,dp04.00,\r\n", b"ap01.00,bp02.00,cp03.00,dp04.00\r\n"),
        (b"an00.00,bn00.00,cn00.00,dn00.00\r\n", ZERO),
    ],
)
def test_a_steady_speed_is_reported_byte_for_byte(sent: bytes, answered: bytes) -> None:
    assert drive(FakeMcu(TRUE), 0, 10, sent)[-1][1] == answered


def test_the_encoders_count_whole_steps() -> None:
    coarse = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=16))
    speeds = {data[2:7] for _, data in drive(FakeMcu(coarse), 0, 50)}
    assert len(speeds) > 1
    assert b"00.00" in speeds
    assert b"12.50" not in speeds


def test_a_motor_follows_with_its_lag() -> None:
    mcu = FakeMcu(Config(sim=SimConfig(motor_time_constant=0.05, encoder_counts=1_000_000)))
    speeds = [float(data[2:7]) for _, data in drive(mcu, 0, 60)]
    assert speeds == sorted(speeds)
    assert speeds[2] < 0.6 * 12.5
    assert speeds[-1] == 12.5


def test_the_commanded_speed_moves_the_vehicle() -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 100, b"ap10.00,bp10.00,cp10.00,dp10.00\r\n")
    assert mcu.vehicle.pose.x == pytest.approx(0.5, abs=0.004)


def test_two_reads_of_the_encoders_within_4_ms_give_the_same_figures() -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 4)
    mcu.receive(50 * MS, b"ap01.00,bp01.00,cp01.00,dp01.00\r\n" + ZERO)
    first, second = (data for _, data in replies(mcu, 80 * MS))
    assert first == second == LINE
    mcu.receive(80 * MS, ZERO)
    ((_, third),) = replies(mcu, 100 * MS)
    assert third != LINE


# time


@pytest.mark.parametrize(("baud", "line_ns"), [(9600, 34_375_000), (115200, 2_864_583)])
def test_a_line_and_its_answer_each_take_their_wire_time(baud: int, line_ns: int) -> None:
    mcu = FakeMcu(at_baud(baud))
    mcu.receive(1000, LINE)
    ((when, _),) = replies(mcu, 200 * MS)
    assert mcu.heard[0] == (1000 + line_ns, LINE)
    processing = when - 1000 - 2 * line_ns
    assert 1 * MS <= processing <= 5 * MS


@pytest.mark.parametrize("baud", [9600, 115200])
def test_lines_sent_together_arrive_one_after_the_other(baud: int) -> None:
    mcu = FakeMcu(at_baud(baud))
    mcu.receive(0, LINE)
    mcu.receive(0, LINE + LINE)
    mcu.advance(500 * MS)
    arrived = [when for when, _ in mcu.heard]
    assert arrived == pytest.approx([n * 330e9 / baud for n in (1, 2, 3)], abs=2)


@pytest.mark.parametrize("baud", [9600, 115200])
def test_answers_leave_one_after_the_other(baud: int) -> None:
    mcu = FakeMcu(at_baud(baud))
    mcu.receive(0, LINE * 8)
    arrived = [when for when, _ in replies(mcu, 2000 * MS)]
    line_ns = int(330e9 / baud)
    assert len(arrived) == 8
    assert all(later - sooner >= line_ns for sooner, later in pairwise(arrived))


def test_processing_takes_a_varying_time_of_one_to_five_milliseconds() -> None:
    chunks = drive(FakeMcu(TRUE), 0, 40)
    delays = [when - n * 10 * MS - 2 * LINE_NS for n, (when, _) in enumerate(chunks)]
    assert len(chunks) >= 39
    assert min(delays) >= 1 * MS - 10
    assert max(delays) <= 5 * MS + 10
    assert max(delays) - min(delays) > 2 * MS


def test_an_answer_arrives_only_when_it_is_complete() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE)
    ((when, _),) = replies(mcu, 100 * MS)
    other = FakeMcu(TRUE)
    other.receive(0, LINE)
    assert other.advance(when - 1) == b""
    assert other.advance(when) == ZERO


def test_the_mcu_is_deterministic() -> None:
    assert drive(FakeMcu(Config()), 0, 50) == drive(FakeMcu(Config()), 0, 50)


def test_the_output_does_not_depend_on_how_often_the_mcu_is_advanced() -> None:
    busy, lazy = FakeMcu(TRUE), FakeMcu(TRUE)
    for mcu in (busy, lazy):
        mcu.receive(0, LINE * 3)
    in_steps = b"".join(busy.advance(n * 100_000) for n in range(1000))
    assert in_steps == lazy.advance(99_900_000)
    assert busy.vehicle.angles == pytest.approx(lazy.vehicle.angles)


# whole valid lines only

INVALID = [
    *(LINE[:n] + b"\r\n" for n in range(31)),
    *(LINE[n:] for n in range(1, 32)),
    *(LINE[:n] + LINE[n + 1 :] for n in range(31)),
    *(LINE[:n] + b"x" + LINE[n + 1 :] for n in range(31)),
    b"\r\n",
    b"\n",
    LINE[:-2] + LINE,
    b"x" + LINE,
    LINE[:-2] + b"x\r\n",
    LINE[:-2] + b",,\r\n",
    LINE.replace(b",", b", "),
    LINE.replace(b"a", b"A"),
    LINE.replace(b"b", b"a"),
    b"bn08.75,ap12.50,cp15.00,dn10.25\r\n",
    b"ap12.50,bn08.75,cp15.00\r\n",
    b"ap12.50,bn08.75,cp15.00,dn10.25,ap12.50\r\n",
    b"ap+2.50,bn08.75,cp15.00,dn10.25\r\n",
    b"ap-2.50,bn08.75,cp15.00,dn10.25\r\n",
    b"ap 2.50,bn08.75,cp15.00,dn10.25\r\n",
    b"ap1e.50,bn08.75,cp15.00,dn10.25\r\n",
    b"apnan00,bn08.75,cp15.00,dn10.25\r\n",
    b"ap100.0,bn08.75,cp15.00,dn10.25x\r\n",
    b"\x00" * 33 + b"\n",
    b"x" * 1000 + b"\n",
    *(token + LINE[7:] for token in (b"ap1.250", b"ap123.4", b"ap0.125")),
]


@each("line", INVALID)
def test_a_line_that_is_not_whole_and_valid_is_recorded_but_has_no_effect(line: bytes) -> None:
    mcu = mcu_after_line(line)
    assert mcu.vehicle.set_points == STILL
    assert mcu.valid_lines == 0
    assert replies(mcu, 200 * MS) == []
    assert len(mcu.heard) == 1


@pytest.mark.parametrize("line", [LINE, LINE.replace(b"\r", b""), LINE[:-2] + b",\r\n"])
def test_any_line_end_and_a_trailing_comma_are_accepted(line: bytes) -> None:
    mcu = mcu_after_line(line)
    assert mcu.vehicle.set_points == SPEEDS
    assert mcu.valid_lines == 1


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


def test_noise_spoils_only_the_line_that_it_hits() -> None:
    mcu = mcu_after_line(b"\xff~" + LINE + b"garbage\r\n" + LINE)
    assert mcu.valid_lines == 1
    assert [data for _, data in mcu.heard] == [b"\xff~" + LINE, b"garbage\r\n", LINE]


# the watchdog


def acted_ns(mcu: FakeMcu) -> int:
    """Return the time at which the line sent at 0 took effect."""
    while not any(mcu.vehicle.set_points):
        due = mcu.next_ns()
        assert due is not None
        mcu.advance(due)
        now_ns = due
    return now_ns


def test_the_motors_stop_300_ms_after_the_last_valid_line() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE)
    start_ns = acted_ns(mcu)
    mcu.advance(start_ns + 300 * MS - 1)
    assert mcu.vehicle.set_points == SPEEDS
    mcu.advance(start_ns + 300 * MS)
    assert mcu.vehicle.set_points == STILL
    assert mcu.watchdog_trips == 1


def test_the_watchdog_stops_the_motors_in_time_even_if_the_mcu_is_advanced_late() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE)
    start_ns = acted_ns(mcu)
    mcu.advance(start_ns + 60_000 * MS)
    assert mcu.vehicle.angles == pytest.approx([speed * 0.3 for speed in SPEEDS])


def test_valid_lines_in_time_keep_the_motors_running() -> None:
    mcu = FakeMcu(TRUE)
    for n in range(10):
        mcu.receive(n * 290 * MS, LINE)
        mcu.advance((n + 1) * 290 * MS)
        assert mcu.vehicle.set_points == SPEEDS
    assert mcu.watchdog_trips == 0


def test_invalid_lines_do_not_keep_the_motors_running() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE)
    for n in range(1, 50):
        mcu.receive(n * 10 * MS, b"garbage\r\n")
        mcu.advance(n * 10 * MS)
    assert mcu.vehicle.set_points == STILL


def test_the_watchdog_does_not_trip_at_rest() -> None:
    mcu = mcu_after_line(ZERO)
    mcu.advance(10_000 * MS)
    assert mcu.watchdog_trips == 0


def test_after_a_trip_the_next_line_drives_again() -> None:
    mcu = mcu_after_line(LINE)
    mcu.advance(1000 * MS)
    assert drive(mcu, 1000 * MS, 3)[-1][1] == LINE


def test_without_watchdog_the_motors_run_on() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.no_watchdog():
        mcu.receive(0, LINE)
        mcu.advance(60_000 * MS)
        assert mcu.vehicle.set_points == SPEEDS
        assert mcu.watchdog_trips == 0


def test_a_watchdog_fed_by_bad_lines_keeps_the_motors_running_until_silence() -> None:
    for fed in (False, True):
        mcu = FakeMcu(TRUE)
        with mcu.watchdog_fed_by_bad_lines() if fed else nullcontext():
            mcu.receive(0, LINE)
            for n in range(1, 10):
                mcu.receive(n * 100 * MS, LINE[:12] + b"\r\n")
                mcu.advance(n * 100 * MS + 50 * MS)
            assert any(mcu.vehicle.set_points) is fed
            mcu.advance(2000 * MS)
            assert not any(mcu.vehicle.set_points)


# reset and boot


def test_a_reset_stops_the_motors_and_leaves_the_board_deaf_for_its_bootloader() -> None:
    mcu = mcu_after_line(LINE)
    mcu.reset(100 * MS)
    assert mcu.vehicle.set_points == STILL
    deaf_until = 100 * MS + RESET_NS
    chunks = drive(mcu, 100 * MS, RESET_NS // (10 * MS))
    assert mcu.vehicle.set_points == STILL
    assert b"".join(data for _, data in chunks).count(b"ap") == 0
    assert [data for _, data in drive(mcu, deaf_until, 3)][-1] == LINE


def test_a_line_is_obeyed_from_the_exact_end_of_the_reset() -> None:
    for early_ns, speeds in ((1, STILL), (0, SPEEDS)):
        mcu = FakeMcu(TRUE)
        mcu.reset(0)
        mcu.receive(RESET_NS - LINE_NS - early_ns, LINE)
        mcu.advance(RESET_NS + 20 * MS)
        assert mcu.vehicle.set_points == speeds


def test_a_reset_prints_noise_that_is_not_a_frame() -> None:
    mcu = FakeMcu(TRUE)
    mcu.reset(0)
    (noise,) = (data for _, data in replies(mcu, RESET_NS))
    assert noise.endswith(b"\n")
    assert b"ap" not in noise


def test_a_reset_discards_the_data_on_the_wire() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, LINE + LINE[:10])
    mcu.reset(1 * MS)
    mcu.receive(RESET_NS + 2 * MS, LINE)
    mcu.advance(RESET_NS + 50 * MS)
    assert [data for _, data in mcu.heard] == [LINE]
    assert mcu.valid_lines == 1


# faults

Fault = Callable[[FakeMcu], AbstractContextManager[None]]

SEALED = LINE[:-2] + b"#07S*EE6B\r\n"

NAMED: dict[str, Fault] = {name: methodcaller(name) for name in FAULTS}
NAMED["bias"] = methodcaller("bias", 2, 1.5)
NAMED["stuck_encoder"] = methodcaller("stuck_encoder", 1)
NAMED["frozen_encoder"] = methodcaller("frozen_encoder", 2)


def story(mcu: FakeMcu, start_ns: int) -> tuple[Heard, list[float], list[float]]:
    """Drive for half a second, then send only one invalid line.

    Return the MCU's replies with times, the wheel angles, and the motors' set points.
    """
    chunks = drive(mcu, start_ns, 40)
    chunks += drive(mcu, start_ns + 400 * MS, 10, SEALED)
    chunks += replies(mcu, start_ns + 650 * MS)
    mcu.receive(start_ns + 650 * MS, b"ap0\r\n")
    chunks += replies(mcu, start_ns + 1000 * MS)
    at = [(when - start_ns, data) for when, data in chunks]
    return at, list(mcu.vehicle.angles), list(mcu.vehicle.set_points)


@each("fault", NAMED.values())
def test_each_fault_changes_the_behaviour(fault: Fault) -> None:
    faulty = FakeMcu(TRUE)
    with fault(faulty):
        assert story(faulty, 0) != story(FakeMcu(TRUE), 0)


@each("fault", NAMED.values())
def test_a_fault_ends_with_its_block(fault: Fault) -> None:
    mended = FakeMcu(TRUE)
    with fault(mended):
        drive(mended, 0, 4, ZERO)
        replies(mended, 250 * MS)
    sound = FakeMcu(TRUE)
    drive(sound, 0, 4, ZERO)
    replies(sound, 250 * MS)
    assert story(mended, 250 * MS) == story(sound, 250 * MS)


@each("fault", NAMED.values())
def test_a_fault_ends_with_its_block_also_after_an_exception(fault: Fault) -> None:
    mended = FakeMcu(TRUE)
    with pytest.raises(KeyError), fault(mended):
        raise KeyError
    assert story(mended, 0) == story(FakeMcu(TRUE), 0)


def test_several_faults_act_together() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.spaces(), mcu.trailing_comma(), mcu.noise(b"~"):
        assert drive(mcu, 0, 5)[-1][1] == b"~ap12.50, bn08.75, cp15.00, dn10.25,\r\n"


def test_a_muted_mcu_drives_but_sends_nothing() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.mute():
        assert drive(mcu, 0, 10) == []
        assert mcu.vehicle.set_points == SPEEDS
        assert mcu.valid_lines == 10


def test_a_muted_mcu_still_identifies_itself() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.mute():
        mcu.receive(0, b"?\r\n")
        ((_, line),) = replies(mcu, 20 * MS)
    assert line.startswith(b"!acsard-mcu ")


def test_the_lines_that_a_fault_loses_are_recorded_too() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.lost_commands(every=1):
        assert drive(mcu, 0, 2) == []
    assert [line for _, line in mcu.heard] == [LINE] * 2


def test_a_bit_error_hits_one_of_two_lines_that_are_written_together() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.bit_errors(every=1):
        mcu.receive(0, LINE * 2)
        mcu.advance(20 * MS)
    assert mcu.valid_lines == 1


def test_the_noise_fault_prepends_noise_to_every_answer() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.noise(b"\x00\xff~"):
        first, *others = (data for _, data in drive(mcu, 0, 5))
    assert first == b"\x00\xff~" + ZERO
    assert others == [b"\x00\xff~" + LINE] * len(others) != []


def test_the_partial_line_fault_sends_the_first_half() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.partial_line():
        assert drive(mcu, 0, 5)[-1][1] == LINE[:16]


def test_a_slow_mcu_acts_and_answers_later_by_its_delay() -> None:
    (prompt,) = drive(FakeMcu(TRUE), 0, 1)
    mcu = FakeMcu(TRUE)
    with mcu.slow_reply(0.03):
        mcu.receive(0, LINE)
        mcu.advance(LINE_NS + 31 * MS)
        assert mcu.vehicle.set_points == STILL
        ((late, _),) = replies(mcu, 100 * MS)
    assert late == prompt[0] + 30 * MS
    assert mcu.vehicle.set_points == SPEEDS


def test_replies_longer_than_the_commands_are_lost_once_the_output_buffer_is_full() -> None:
    mcu, count = FakeMcu(TRUE), 1000
    with mcu.spaces():
        mcu.receive(0, LINE * count)
        chunks = replies(mcu, 10_000 * MS)
    assert count * 0.85 < len(chunks) < count * 0.95
    wire_ns = count * LINE_NS
    assert all(due < wire_ns + 30 * MS for due, _ in chunks)
    assert {len(line) for _, line in chunks} == {len(LINE) + 3}


def test_the_spaces_fault_adds_a_space_after_every_comma_with_its_wire_time() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.spaces():
        (when, data) = drive(mcu, 0, 1)[0]
        assert data == b"ap00.00, bp00.00, cp00.00, dp00.00\r\n"
    assert when == drive(FakeMcu(TRUE), 0, 1)[0][0] + 3 * 10 * 1_000_000_000 // 115200 + 1


def test_the_trailing_comma_fault_ends_the_answer_with_a_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.trailing_comma():
        assert drive(mcu, 0, 5)[-1][1] == LINE[:-2] + b",\r\n"


@each(("motor", "token"), [(0, b"ap18.75"), (1, b"bn13.12"), (2, b"cp22.50"), (3, b"dn15.38")])
def test_a_bias_changes_the_report_of_one_motor_but_not_its_motion(
    motor: int, token: bytes
) -> None:
    mcu, sound = FakeMcu(TRUE), FakeMcu(TRUE)
    with mcu.bias(motor, 1.5):
        data = drive(mcu, 0, 5)[-1][1]
    drive(sound, 0, 5)
    expected = LINE[:-2].split(b",")
    tokens = data[:-2].split(b",")
    assert abs(float(tokens[motor][2:]) - float(token[2:])) <= 0.011
    assert tokens[motor][:2] == token[:2]
    assert tokens[:motor] + tokens[motor + 1 :] == expected[:motor] + expected[motor + 1 :]
    assert mcu.vehicle.angles == sound.vehicle.angles


def test_two_biases_can_be_active_together() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.bias(0, 0.0), mcu.bias(2, 0.0):
        assert drive(mcu, 0, 5)[-1][1] == b"ap00.00,bn08.75,cp00.00,dn10.25\r\n"
    assert drive(mcu, 50 * MS, 1)[-1][1] == LINE


@each("motor", range(4))
def test_a_stuck_encoder_reports_zero_while_its_wheel_turns(motor: int) -> None:
    mcu = FakeMcu(TRUE)
    with mcu.stuck_encoder(motor):
        tokens = drive(mcu, 0, 5)[-1][1][:-2].split(b",")
    assert tokens[motor] == b"abcd"[motor : motor + 1] + b"p00.00"
    assert [t for t in tokens if not t.endswith(b"p00.00")] == [
        t for i, t in enumerate(LINE[:-2].split(b",")) if i != motor
    ]
    assert mcu.vehicle.speeds == SPEEDS


@each("motor", range(4))
def test_a_frozen_encoder_keeps_its_last_speed_while_its_wheel_stops(motor: int) -> None:
    mcu = FakeMcu(TRUE)
    before = drive(mcu, 0, 5)[-1][1][:-2].split(b",")
    with mcu.frozen_encoder(motor):
        stopped = drive(mcu, 50 * MS, 5, b"ap00.00,bp00.00,cp00.00,dp00.00\r\n")
    after = stopped[-1][1][:-2].split(b",")
    assert after[motor] == before[motor]
    assert all(t.endswith(b"p00.00") for i, t in enumerate(after) if i != motor)
    assert mcu.vehicle.speeds == [0.0] * 4


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


def test_an_encoder_whose_wires_are_swapped_stays_reversed() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.swapped_encoders(0, 1), mcu.reversed_encoder(0):
        assert drive(mcu, 0, 6)[-1][1] == b"an08.75,bn12.50,cp15.00,dn10.25\r\n"


def test_a_comma_latched_mcu_keeps_its_last_wheel_without_a_trailing_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.comma_latched():
        drive(mcu, 0, 1)
        assert mcu.vehicle.set_points == [12.5, -8.75, 15.0, 0.0]
        drive(mcu, 10 * MS, 1, LINE[:-2] + b",\r\n")
        assert mcu.vehicle.set_points == SPEEDS
        drive(mcu, 20 * MS, 1, ZERO)
        assert mcu.vehicle.set_points == [0.0, 0.0, 0.0, -10.25]
        drive(mcu, 30 * MS, 1, ZERO[:-2] + b",\r\n")
        assert mcu.vehicle.set_points == STILL


def test_a_comma_latched_mcu_takes_the_wheels_of_a_damaged_line_one_by_one() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.comma_latched():
        drive(mcu, 0, 1, b"ap12.50,bx08.75,cp1?.00,dn10.25,\r\n")
        assert mcu.vehicle.set_points == [12.5, 0.0, 0.0, -10.25]


def test_an_unprompted_mcu_reports_by_its_own_clock_unpadded_and_with_a_comma() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.1):
        chunks = drive(mcu, 0, 40, b"ap02.50,bn08.75,cp15.00,dp00.00\r\n")
    expected = b"ap2.50,bn8.75,cp15.00,dp0.00,\r\n"
    assert len(chunks) == 3
    assert {data for _, data in chunks[1:]} == {expected}
    gaps = [later - sooner for (sooner, _), (later, _) in pairwise(chunks[1:])]
    assert gaps == [100 * MS]
    assert mcu.valid_lines == 40


def test_an_unprompted_mcu_reports_also_without_commands() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.05):
        chunks = replies(mcu, 1000 * MS)
    assert len(chunks) == 19


def test_an_unprompted_mcu_reports_again_after_its_reset() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.1):
        mcu.reset(0)
        mcu.advance(RESET_NS)
        assert b"ap0.00" in mcu.advance(RESET_NS + 1000 * MS)


def test_entering_unprompted_twice_does_not_double_its_rate() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.free_running(0.1):
        mcu.advance(50 * MS)
    with mcu.free_running(0.1):
        out = mcu.advance(1050 * MS)
    assert out.count(b"\n") <= 10


def test_an_unprompted_mcu_reports_nothing_while_it_boots() -> None:
    mcu = FakeMcu(TRUE)
    mcu.reset(0, 1000 * MS)
    with mcu.free_running(0.1):
        assert b"," not in mcu.advance(900 * MS), "no report, only the noise of the bootloader"


def test_a_comma_latched_mcu_survives_a_speed_that_is_not_a_number() -> None:
    mcu = FakeMcu(Config())
    with mcu.comma_latched():
        mcu.receive(0, b"apnan,bp01.00,cp01.00,dp01.00,\r\n")
        mcu.receive(50 * MS, LINE)
        mcu.advance(500 * MS)


def arrivals(mcu: FakeMcu, count: int = 100) -> Heard:
    """Return the data that the host reads each ms from an MCU that is prompted every 10 ms."""
    chunks = []
    for ms in range(10 * count + 200):
        if ms % 10 == 0 and ms < 10 * count:
            mcu.receive(ms * MS, LINE)
        data = mcu.advance(ms * MS)
        if data:
            chunks.append((ms * MS, data))
    return chunks


def joined(chunks: Heard) -> bytes:
    return b"".join(data for _, data in chunks)


def test_a_usb_adapter_delivers_every_16_ms_and_loses_nothing() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.ftdi():
        chunks = arrivals(mcu)
    assert {len(data) for when, data in chunks if when % (16 * MS)} <= {62}
    assert joined(chunks) == joined(arrivals(FakeMcu(TRUE)))
    assert any(len(data) > len(LINE) for _, data in chunks)


def test_a_full_packet_of_the_adapter_does_not_wait() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.ftdi(latency_s=0.1):
        chunks = arrivals(mcu)
    early = [data for when, data in chunks if when % (100 * MS)]
    assert early
    assert {len(data) for data in early} == {62}
    assert joined(chunks) == joined(arrivals(FakeMcu(TRUE)))


def test_data_that_the_adapter_holds_when_the_fault_ends_arrive_in_order() -> None:
    mcu, sound = FakeMcu(TRUE), FakeMcu(TRUE)
    with mcu.ftdi(latency_s=10.0):
        assert drive(mcu, 0, 1) == []
        replies(mcu, 50 * MS)
    drive(sound, 0, 1)
    replies(sound, 50 * MS)
    whole = joined(drive(mcu, 50 * MS, 20))
    later = joined(drive(sound, 50 * MS, 20))
    assert whole.endswith(later)
    assert len(whole) == len(later) + len(LINE)


def test_no_data_arrive_during_a_stall_and_all_of_them_after_it() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.stalls(0.5, 0.15):
        chunks = arrivals(mcu)
    assert not [when for when, _ in chunks if when % (500 * MS) < 150 * MS]
    (burst,) = [data for when, data in chunks if when == 650 * MS]
    assert burst.count(b"\n") >= 14
    assert joined(chunks) == joined(arrivals(FakeMcu(TRUE)))


def test_stalls_and_an_adapter_together_lose_no_data() -> None:
    mcu = FakeMcu(TRUE)
    with mcu.ftdi(), mcu.stalls(0.3, 0.1):
        chunks = arrivals(mcu)
    assert not [when for when, _ in chunks if when % (300 * MS) < 100 * MS]
    assert joined(chunks) == joined(arrivals(FakeMcu(TRUE)))
