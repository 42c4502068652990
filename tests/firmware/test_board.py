"""The firmware's machine code, run in a simulator, drives the motors and reports them correctly.

The tests assert times of the board's simulated clock, and print real times next to them.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.firmware.board import (
    MS,
    STOP,
    Board,
    Host,
    Reply,
    Speeds,
    Status,
    build_firmware,
    checked,
    passes,
    read_reply,
    speeds_line,
)
from tests.system.harness import until

pytestmark = pytest.mark.firmware

in_steps = pytest.mark.usefixtures("in_steps")
"""Mark of a test that compares times of the host with times of the board.

A busy machine delays either of them. The board would then see a silence, or skip a part of its
time. In steps it does neither.
"""

KNOWN = b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1"
"""The beginning of every identity line."""

POWERED_ON = KNOWN + b" lines=0 refused=0 trips=0 runaways=0 reset=power"

BY_PIN = KNOWN + b" lines=0 refused=0 trips=0 runaways=0 reset=pin"

BY_WATCHDOG = KNOWN + b" lines=0 refused=0 trips=0 runaways=0 reset=watchdog"

ZERO = STOP

DRIVE: Speeds = (10.0, -5.0, 20.0, -30.0)

STOPPED: Speeds = (0.0, 0.0, 0.0, 0.0)

COUNTS_PER_TURN = 3200


def is_off(status: Status) -> bool:
    return not status.running and all(motor.duty == 0.0 for motor in status.motors)


def stays_off(board: Board, ms: int) -> Status:
    """Check that no motor gets any voltage for `ms` of the board's simulated time."""
    before = board.status()
    assert is_off(before)
    after = passes(board, ms)
    assert is_off(after)
    assert after.on_ns == before.on_ns, "not for a moment"
    return after


def is_still(board: Board) -> Status:
    """Wait until no motor turns or has voltage, and return the board's state."""

    def look() -> Status | None:
        status = board.status()
        # The remaining motion must be far less than a count, or one more count may come after any
        # answer.
        still = all(abs(motor.speed) < 1e-6 for motor in status.motors)
        return status if still and is_off(status) else None

    return until(look, 10.0, "standstill")


def wrapped(counts: Sequence[int]) -> tuple[int, ...]:
    return tuple(count % 65536 for count in counts)


def difference(before: int, after: int) -> int:
    """Return the difference of two counts modulo 65536."""
    return (after - before + 32768) % 65536 - 32768


# the contract


def test_an_integral_wound_up_before_a_stop_does_not_drive_after_it(
    board: Board, host: Host
) -> None:
    for motor in "abcd":
        board.command(f"load {motor} 1")
    host.drive((20.0, 20.0, 20.0, 20.0), 0.6)
    assert all(motor.duty == 1.0 for motor in board.status().motors), "as hard as they can"
    status = until(lambda: s if is_off(s := board.status()) else None, 3.0, "motors off")
    host.drive(STOPPED, 0.3)
    assert board.status().on_ns == status.on_ns, "not for a moment"


@pytest.mark.parametrize(
    ("how", "what"), [("l", "the main loop"), ("i", "all, interrupts off"), ("c", "the clock")]
)
def test_the_hardware_watchdog_resets_the_board_when_its_program_hangs(
    runner: Path, hanging_firmware: Path, how: str, what: str
) -> None:
    with Board(runner, hanging_firmware) as board, Host(board.path) as host:
        host.drive(DRIVE, 0.3)
        assert board.status().running
        host.lines()
        host.send(b"!" + how.encode())
        status = until(lambda: s if (s := board.status()).resets else None, 3.0, "a reset")
        took = (status.off_ns - status.heard_ns) / MS
        print(f"{what} hangs -> motors off: {took:.1f} ms")
        assert took <= 150
        assert is_off(status)
        assert host.says(b"acsard") == BY_WATCHDOG
        assert stays_off(board, 300).resets == 1, "and it does not go on resetting"
        host.stop()
        host.drive(DRIVE, 0.2)
        assert board.status().running


BAD_LINES = [
    b"", b"hello", b"ap10.00", b"ap10.00,bp10.00,cp10.00", b"ap10.00,bp10.00,cp10.00,",
    b"ap10.00,ap10.00,cp10.00,dp10.00", b"ap10.00,bp10.00,cp10.00,dp100.00",
    b"ap10.00,bp10.00,cp10.00,dp10", b"\x00ap10.00,bp10.00,cp10.00,dp10.00",
    b" ap10.00,bp10.00,cp10.00,dp10.00", b"ap10.00,bp10.00,cp10.00,dp10.00 ",
    b"ap10.00,bp10.00,cp10.00,dp99.999", b"ap10.00,bp10.00,cp10.00,dp10.00#07",
    b"ap10.00,bp10.00,cp10.00,dp10.00#07*0000", b"ap10.00;bp10.00;cp10.00;dp10.00",
    b"\xff" * 200, b"??", b"!",
]  # fmt: skip


def test_the_board_counts_lines_refusals_and_watchdog_stops(board: Board, host: Host) -> None:
    assert host.identity() == (3200, 300, 1, 1, 0, 0, 0, 0, "power")
    for line in BAD_LINES[1:]:
        host.send(line)
    host.send(b"")
    refused = len(BAD_LINES) - 1
    assert host.identity()[4:] == (0, refused, 0, 0, "power"), "an empty line is none"
    host.ask(ZERO)
    until(lambda: host.identity().lines == 1, 3.0, "it has counted")
    stays_off(board, 400)
    assert host.identity().trips == 0, "nothing ran"
    for trips in (1, 2):
        host.drive(DRIVE, 0.2)
        until(lambda: is_off(board.status()), 3.0, "motors off")
        assert host.identity().trips == trips
    asked, executed = board.status().to_board.lines, host.identity().lines
    host.drive(DRIVE, 0.2)
    executed = host.identity().lines - executed
    assert executed >= 20
    assert board.status().to_board.lines == asked + 2 + executed, "the bench counts as it does"
    assert board.status().wrong == 0
    board.command("reset")
    assert host.says(b"acsard") == BY_PIN


# driving


def reached(board: Board, host: Host, speeds: Speeds, seconds: float = 1.0) -> list[Reply]:
    """Drive for `seconds` to reach the speeds, and return the replies of the following 0.5 s."""
    host.drive(speeds, seconds)
    return host.drive(speeds, 0.5)


# replies


def test_each_line_is_answered_once_with_its_sequence(board: Board, host: Host) -> None:
    for sequence in range(256):
        letters = ("", "S", "Z")[sequence % 3]
        reply = host.ask(checked(ZERO, sequence, letters))
        assert reply.sequence == sequence
        assert (reply.milliseconds is not None) == (letters == "S")
    wire = board.status().from_board
    assert wire.bytes - len(POWERED_ON) - 4 == 86 * 41 + 85 * 62 + 85 * 41, "and nothing else"


def test_the_counts_are_the_true_counts(board: Board, host: Host) -> None:
    host.drive(DRIVE, 0.7)
    status = is_still(board)
    assert status.resets == 0
    reply = host.ask(checked(ZERO, 7, "S"))
    true = [motor.since_reset for motor in board.status().motors]
    print("counts", reply.counts, "true", true)
    assert reply.counts == wrapped(true)
    # After a reset the board counts from zero again.
    board.command("reset")
    host.says(b"acsard")
    host.stop()
    host.drive(DRIVE, 0.3)
    is_still(board)
    reply = host.ask(checked(ZERO, 7, "S"))
    assert reply.counts == wrapped([motor.since_reset for motor in board.status().motors])


def test_counts_and_milliseconds_give_the_speed_without_the_line_s_jitter(
    board: Board, host: Host
) -> None:
    replies = reached(board, host, DRIVE)
    turns = []
    for before, after in itertools.pairwise(replies):
        assert before.milliseconds is not None
        assert after.milliseconds is not None
        ms = (after.milliseconds - before.milliseconds) % 65536
        if ms:  # within 5 ms the same reading is sent again
            assert ms >= 5
            step = difference(before.counts[3], after.counts[3])
            turns.append(step / COUNTS_PER_TURN * 2 * 3.14159265 / ms * 1000)
        else:
            assert before.counts == after.counts
            assert before.speeds == after.speeds
    mean, noise = statistics.mean(turns), statistics.pstdev(turns)
    print(f"-30 rad/s by counts and time: {mean:.3f} +- {noise:.3f}")
    assert mean == pytest.approx(-30.0, rel=0.005)
    assert all(turn == pytest.approx(-30.0, abs=0.8) for turn in turns)


# under stress


def test_damaged_and_lost_bytes_cost_lines_and_nothing_else(board: Board, host: Host) -> None:
    """The board drives on with the valid lines, at the commanded speeds only.

    Every 83rd byte has a wrong bit, and every 211th byte is lost.
    """
    board.command("noise to 83")
    board.command("drop to 211")
    replies = host.drive(DRIVE, 2.0)
    status = board.status()
    assert status.wrong == 0
    share = len(replies) / (status.to_board.bytes / 42)
    print(f"{status.to_board.damaged} bytes damaged, {status.to_board.lost} lost; "
          f"{share:.0%} of the lines answered")  # fmt: skip
    assert 0.2 < share < 0.7
    for motor, wanted in zip(status.motors, DRIVE, strict=True):
        assert motor.speed == pytest.approx(wanted, rel=0.01, abs=0.02)


def test_a_host_that_never_pauses_is_answered_and_controlled(board: Board, host: Host) -> None:
    """The host sends lines without pauses, which are more than the board can answer.

    The board still answers many of them, and controls the speeds on time.
    """
    line = checked(speeds_line(DRIVE), 0, "S") + b"\r\n"
    replies: list[Reply] = []
    host.stop()
    end = time.monotonic() + 2.0
    began = board.status()
    while time.monotonic() < end:
        ahead = began.to_board.bytes + (time.monotonic() - end + 2.0) * 11520 + 300
        if board.status().to_board.bytes < ahead:
            host.write(line * 4)
        replies += [read_reply(answer, at) for at, answer in host.lines(0.002)]
    status = board.status()
    lines = (status.to_board.bytes - began.to_board.bytes) // len(line)
    print(f"{lines} lines in 2 s, {len(replies)} answered; load {status.load:.0%}")
    assert status.resets == 0
    assert lines > 400
    assert len(replies) > 300
    assert all(
        m.speed == pytest.approx(w, rel=0.01) for m, w in zip(status.motors, DRIVE, strict=True)
    )


@pytest.mark.parametrize("speed", [20.0, 40.0, 60.0])
@pytest.mark.nightly
def test_the_board_counts_every_edge_of_fast_wheels(
    runner: Path, firmware: Path, speed: float
) -> None:
    with Board(runner, firmware, "--free-speed", "70,70,70,70") as board, Host(board.path) as host:
        host.drive((speed, -speed, speed, -speed), 1.0)
        before = board.status()
        host.drive((speed, -speed, speed, -speed), 1.0)
        after = board.status()
        span = after.virtual_ns - before.virtual_ns
        load = (after.load * after.virtual_ns - before.load * before.virtual_ns) / span
        edges = sum(
            abs(a.counts - b.counts) for a, b in zip(after.motors, before.motors, strict=True)
        )
        print(f"{speed} rad/s: {edges / span * 1e6:.0f} edges/ms, processor busy {load:.0%}")
        assert after.resets == 0
        is_still(board)
        reply = host.ask(checked(ZERO, 7, "S"))
        assert reply.counts == wrapped([motor.since_reset for motor in board.status().motors])


def test_an_overflow_of_the_receive_buffer_does_not_damage_the_next_line(
    runner: Path, hanging_firmware: Path
) -> None:
    """The main loop pauses for 60 ms, and twice as many bytes arrive as the buffer can store."""
    with Board(runner, hanging_firmware) as board, Host(board.path) as host:
        lines = b"".join(checked(ZERO, i) + b"\r\n" for i in range(12))
        host.write(b"!p\r\n" + lines)
        until(
            lambda: board.status().to_board.bytes == 4 + len(lines), 5.0, "all bytes are received"
        )
        host.says(b"#00")
        host.send(checked(ZERO, 99))
        host.says(b"#63")
        assert board.status().resets == 0
        answered = (board.status().from_board.bytes - len(POWERED_ON) - 4) // 41 - 1
        print(f"12 lines in a pause of 60 ms: {answered} answered")
        assert 0 < answered < 12


def is_cut(board: Board, host: Host, speeds: Speeds, within: float) -> Status:
    """Drive until the firmware switches off all motors because one wheel does not obey."""
    began = board.status().virtual_ns
    while (status := board.status()).running or not status.off_ns > began:
        assert (status.virtual_ns - began) / MS < 1000 * within, status.motors
        host.drive(speeds, 0.02)
    return status


def stays_cut(board: Board, host: Host) -> None:
    """Check that the board answers lines but keeps the motors off until the host was silent."""
    before = board.status()
    replies = host.drive(DRIVE, 0.7)
    assert len(replies) >= 60
    assert replies[-1].milliseconds is not None
    assert board.status().on_ns == before.on_ns, "not for a moment"
    assert (identity := host.identity()).runaways == 1
    assert identity.trips == 0, "the silence had nothing to cut"
    stays_off(board, 400)
    replies = host.drive((5.0, 0.0, 5.0, 5.0), 0.5)
    assert board.status().running, "silence has freed them"


@in_steps
def test_a_wheel_with_its_encoder_backwards_is_cut(board: Board, host: Host) -> None:
    board.command("encoder b swapped")
    host.stop()
    is_cut(board, host, (-20.0,) * 4, 0.5)
    stays_cut(board, host)


@in_steps
def test_a_reset_frees_motors_that_were_cut(board: Board, host: Host) -> None:
    board.command("encoder b swapped")
    is_cut(board, host, (9.0, 9.0, 9.0, 9.0), 0.8)
    board.command("encoder b ok")
    board.command("reset")
    assert host.says(b"acsard") == BY_PIN
    host.stop()
    host.drive(DRIVE, 0.2)
    assert board.status().running


def test_at_the_lowest_pwm_frequency_the_duty_rises_to_the_top(
    runner: Path, tmp_path: Path
) -> None:
    """At this frequency the sum of the duty and its step upwards exceeds 16 bits."""
    slow = build_firmware(tmp_path, "-DPWM_HZ=250UL")
    with Board(runner, slow) as board, Host(board.path) as host:
        host.drive((49.0, -49.0, 49.0, 49.0), 0.4)
        for _ in range(20):
            host.drive((49.0, -49.0, 49.0, 49.0), 0.02)
            assert min(abs(motor.duty) for motor in board.status().motors) > 0.9


@pytest.mark.parametrize("baud_rate", [9600, 57600])
@pytest.mark.nightly
def test_the_board_works_at_other_baud_rates(runner: Path, tmp_path: Path, baud_rate: int) -> None:
    slow = build_firmware(tmp_path, f"-DBAUD_RATE={baud_rate}UL")
    with Board(runner, slow, "--baud", str(baud_rate)) as board, Host(board.path) as host:
        began = board.status().virtual_ns
        host.ask(checked(ZERO, 1, "S"))
        took = (board.status().virtual_ns - began) / MS
        wire = (42 + 62) * 10 / baud_rate * 1000
        print(f"{baud_rate} baud: there and back in {took:.1f} ms, of it {wire:.1f} ms on the wire")
        assert took > 0.9 * wire
        replies = host.drive(DRIVE, 2.0, period=2 * wire / 1000)
        assert replies[-1].speeds == pytest.approx(DRIVE, rel=0.02)


def test_with_require_check_plain_lines_except_stops_are_refused_after_a_checked_line(
    runner: Path, tmp_path: Path
) -> None:
    strict = build_firmware(tmp_path, "-DREQUIRE_CHECK=1")
    with Board(runner, strict) as board, Host(board.path) as host:
        assert host.ask(ZERO).line == ZERO
        host.ask(checked(ZERO, 1))
        host.send(speeds_line(DRIVE))
        assert host.ask(checked(ZERO, 2)).sequence == 2, "and no answer before that"
        host.drive(DRIVE, 0.2)
        assert host.ask(ZERO).line.startswith(b"ap"), "but a stop is never refused"
        assert host.identity().refused == 1
        is_still(board)
        board.command("reset")
        host.says(b"acsard")
        assert host.ask(ZERO).line == ZERO
