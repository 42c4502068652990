"""The C firmware's checked lines, counters, safety stops and limits, in the simulated board."""

from __future__ import annotations

import itertools
import math
import statistics
from pathlib import Path

import pytest

from tests.firmware.board import (
    DRIVE,
    MS,
    STOP,
    Board,
    Host,
    Reply,
    Status,
    build_firmware,
    checked,
    read_reply,
    speeds_line,
)

pytestmark = pytest.mark.firmware

KNOWN = b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1"
"""The beginning of every identity line."""

BOOTED = KNOWN + b" lines=0 refused=0 trips=0 runaways=0 reset="

COUNTS_PER_TURN = 3200


def difference(before: int, after: int) -> int:
    """Return the difference of two counts modulo 65536."""
    return (after - before + 32768) % 65536 - 32768


def check_counts(host: Host) -> None:
    """Check that the reported counts are those of the simulated encoders."""
    true = host.board.is_still().motors
    reply = host.ask(checked(STOP, 7, "S"))
    assert reply.counts == tuple(motor.since_reset % 65536 for motor in true)


# lines and counters


@pytest.mark.parametrize("how", ["l", "i", "c"], ids=["the loop", "all", "the clock"])
def test_the_hardware_watchdog_resets_the_board_when_its_program_hangs(
    runner: Path, hanging_firmware: Path, how: str
) -> None:
    with Board(runner, hanging_firmware) as board, Host(board) as host:
        host.drive(DRIVE, 0.3)
        assert board.status().running
        host.send(b"!" + how.encode())
        status = board.waits(lambda status: status.resets == 1, "a reset")
        took = (status.off_ns - status.heard_ns) / MS
        print(f"it hangs -> motors off: {took:.1f} ms")
        assert took <= 150
        assert status.is_off
        assert host.says(b"acsard") == BOOTED + b"watchdog"
        assert board.stays_off(300).resets == 1, "and it does not go on resetting"
        host.stop()
        host.drive(DRIVE, 0.2)
        assert board.status().running


def test_the_board_counts_lines_refusals_and_watchdog_stops(host: Host) -> None:
    board = host.board
    assert host.identity() == (3200, 300, 1, 1, 0, 0, 0, 0, "power")
    for line in (b"hello", b"", b"\xff" * 200, STOP + b"#07*0000"):
        host.send(line)
    assert host.identity()[4:] == (0, 3, 0, 0, "power"), "an empty line is none"
    host.ask(STOP)
    assert host.identity().lines == 1
    board.stays_off(400)
    assert host.identity().trips == 0, "nothing ran"
    for trips in (1, 2):
        host.drive(DRIVE, 0.2)
        assert board.passes(400).is_off
        assert host.identity().trips == trips
    assert (host.identity().lines, board.status().wrong) == (42, 0)
    board.command("reset")
    assert host.says(b"acsard") == BOOTED + b"pin"


def test_each_line_is_answered_once_with_its_sequence(host: Host) -> None:
    for sequence in range(256):
        letters = ("", "S", "Z")[sequence % 3]
        reply = host.ask(checked(STOP, sequence, letters))
        assert reply.sequence == sequence
        assert (reply.milliseconds is not None) == (letters == "S")
    wire = host.board.status().from_board
    assert wire.bytes - len(BOOTED + b"power") - 4 == 86 * 41 + 85 * 62 + 85 * 41, "and no more"


def test_with_require_check_plain_lines_except_stops_are_refused_after_a_checked_line(
    runner: Path, tmp_path: Path
) -> None:
    strict = build_firmware(tmp_path, "-DREQUIRE_CHECK=1")
    with Board(runner, strict) as board, Host(board) as host:
        assert host.ask(STOP).line == STOP
        host.ask(checked(STOP, 1))
        host.send(speeds_line(DRIVE))
        assert host.ask(checked(STOP, 2)).sequence == 2, "and no answer before that"
        host.drive(DRIVE, 0.2)
        assert host.ask(STOP).line.startswith(b"ap"), "but a stop is never refused"
        assert host.identity().refused == 1
        board.is_still()
        board.command("reset")
        host.says(b"acsard")
        assert host.ask(STOP).line == STOP


def test_an_overflow_of_the_receive_buffer_does_not_damage_the_next_line(
    runner: Path, hanging_firmware: Path
) -> None:
    """The main loop pauses for 60 ms, and twice as many bytes arrive as the buffer can store."""
    with Board(runner, hanging_firmware) as board, Host(board) as host:
        host.write(b"!p\r\n" + b"".join(checked(STOP, i) + b"\r\n" for i in range(12)))
        answered = len(host.lines(200))
        assert host.ask(checked(STOP, 99)).sequence == 99
        assert board.status().resets == 0
        print(f"12 lines in a pause of 60 ms: {answered} answered")
        assert 0 < answered < 12


# counts and speeds


def test_the_counts_are_the_true_counts_also_after_a_reset(host: Host) -> None:
    host.drive(DRIVE, 0.7)
    check_counts(host)
    host.board.command("reset")
    host.says(b"acsard")
    host.stop()
    host.drive(DRIVE, 0.3)
    check_counts(host)


def test_counts_and_milliseconds_give_the_speed_without_the_line_s_jitter(host: Host) -> None:
    """The host sends its lines in pairs: within 5 ms the same reading is sent again."""
    host.drive(DRIVE, 1.0)
    pair = b"".join(checked(speeds_line(DRIVE), i, "S") + b"\r\n" for i in range(2))
    replies: list[Reply] = []
    for _ in range(50):
        host.write(pair)
        replies += map(read_reply, host.lines(12))
    assert len(replies) >= 98
    turns = []
    for before, after in itertools.pairwise(replies):
        assert before.milliseconds is not None
        assert after.milliseconds is not None
        ms = (after.milliseconds - before.milliseconds) % 65536
        if ms:
            assert ms >= 5
            step = difference(before.counts[3], after.counts[3])
            turns.append(step / COUNTS_PER_TURN * math.tau / ms * 1000)
        else:
            assert (before.counts, before.speeds) == (after.counts, after.speeds)
    mean, noise = statistics.mean(turns), statistics.pstdev(turns)
    print(f"-30 rad/s by counts and time: {mean:.3f} +- {noise:.3f}")
    assert mean == pytest.approx(-30.0, rel=0.005)
    assert all(turn == pytest.approx(-30.0, abs=0.8) for turn in turns)


@pytest.mark.parametrize("speed", [20.0, 40.0, 60.0])
@pytest.mark.nightly
def test_the_board_counts_every_edge_of_fast_wheels(
    runner: Path, firmware: Path, speed: float
) -> None:
    with Board(runner, firmware, "--free-speed", "70,70,70,70") as board, Host(board) as host:
        host.drive((speed, -speed, speed, -speed), 2.0)
        status = board.status()
        print(f"{speed} rad/s: processor busy {status.load:.0%}")
        assert status.resets == 0
        check_counts(host)


# the wire


def test_damaged_and_lost_bytes_cost_lines_and_nothing_else(host: Host) -> None:
    """The board drives on with the valid lines, at the commanded speeds only.

    Every 83rd byte has a wrong bit, and every 211th byte is lost.
    """
    host.board.command("noise to 83")
    host.board.command("drop to 211")
    replies = host.drive(DRIVE, 2.0)
    status = host.board.status()
    assert status.wrong == 0
    assert 40 < len(replies) < 140
    assert [motor.speed for motor in status.motors] == pytest.approx(DRIVE, rel=0.01, abs=0.02)


@pytest.mark.parametrize("baud_rate", [9600, 57600])
@pytest.mark.nightly
def test_the_board_works_at_other_baud_rates(runner: Path, tmp_path: Path, baud_rate: int) -> None:
    slow = build_firmware(tmp_path, f"-DBAUD_RATE={baud_rate}UL")
    with Board(runner, slow, "--baud", str(baud_rate)) as board, Host(board) as host:
        there_and_back_s = (42 + 62) * 10 / baud_rate
        replies = host.drive(DRIVE, 2.0, period=2 * there_and_back_s)
        assert len(replies) >= round(2.0 / (2 * there_and_back_s)) - 1
        assert replies[-1].speeds == pytest.approx(DRIVE, rel=0.02)


# motors


def is_cut(host: Host, speed: float, within_s: float) -> None:
    """Drive until the firmware switches off all motors because one wheel does not obey."""
    host.stop()
    for _ in range(round(within_s / 0.02)):
        host.drive((speed,) * 4, 0.02)
        status: Status = host.board.status()
        if status.off_ns > status.on_ns > 0:
            return
    raise AssertionError(host.board.status().motors)


def test_a_wheel_with_its_encoder_backwards_is_cut_until_the_host_was_silent(host: Host) -> None:
    board = host.board
    board.command("encoder b swapped")
    is_cut(host, -20.0, 0.5)
    before = board.status()
    assert len(host.drive(DRIVE, 0.7)) >= 60, "lines are answered"
    assert board.status().on_ns == before.on_ns, "not for a moment"
    assert (identity := host.identity()).runaways == 1
    assert identity.trips == 0, "the silence had nothing to cut"
    board.stays_off(400)
    host.drive((5.0, 0.0, 5.0, 5.0), 0.5)
    assert board.status().running, "silence has freed them"


def test_a_reset_frees_motors_that_were_cut(host: Host) -> None:
    host.board.command("encoder b swapped")
    is_cut(host, 9.0, 0.8)
    host.board.command("encoder b ok")
    host.board.command("reset")
    assert host.says(b"acsard") == BOOTED + b"pin"
    host.stop()
    host.drive(DRIVE, 0.2)
    assert host.board.status().running


def test_at_the_lowest_pwm_frequency_the_duty_rises_to_the_top(
    runner: Path, tmp_path: Path
) -> None:
    """At this frequency the sum of the duty and its step upwards exceeds 16 bits."""
    slow = build_firmware(tmp_path, "-DPWM_HZ=250UL")
    with Board(runner, slow) as board, Host(board) as host:
        host.drive((49.0, -49.0, 49.0, 49.0), 0.4)
        for _ in range(20):
            host.drive((49.0, -49.0, 49.0, 49.0), 0.02)
            assert min(abs(motor.duty) for motor in board.status().motors) > 0.9
