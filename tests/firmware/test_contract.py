"""What each firmware for the robot promises, with the C firmware and the Arduino sketch.

The machine code runs in a simulator, and the times are those of the board. All lines are plain.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.firmware.board import (
    MS,
    STOP,
    Board,
    Host,
    Speeds,
    Status,
    build_sketch,
    passes,
    speeds_line,
)
from tests.firmware.conftest import ESTOP, FREE_SPEEDS
from tests.system.harness import until
from tests.system.typed import typed

pytestmark = pytest.mark.firmware

DRIVE: Speeds = (10.0, -5.0, 20.0, -30.0)

STOPPED: Speeds = (0.0, 0.0, 0.0, 0.0)

BOOTED = b"!acsard-mcu "


def is_off(status: Status) -> bool:
    return not status.running and all(motor.duty == 0.0 for motor in status.motors)


def stays_off(board: Board, ms: int) -> None:
    """Check that no motor gets any voltage for `ms` of the board's simulated time."""
    before = board.status()
    assert is_off(before)
    after = passes(board, ms)
    assert is_off(after)
    assert after.on_ns == before.on_ns, "not for a moment"


def off_after(board: Board) -> float:
    """Wait until the motors are off. Return the time since the last byte that came, ms."""
    status = until(lambda: s if is_off(s := board.status()) else None, 3.0, "motors off")
    return (status.off_ns - status.heard_ns) / MS


@pytest.fixture(params=["firmware", "sketch"])
def board(runner: Path, request: pytest.FixtureRequest) -> Iterator[Board]:
    program = request.getfixturevalue(request.param)
    with Board(runner, program, "--free-speed", FREE_SPEEDS) as board, board.in_steps():
        yield board


@pytest.fixture
def host(board: Board) -> Iterator[Host]:
    with Host(board.path, board) as host:
        host.plain = True
        yield host


def test_motors_are_off_until_zeros_have_come_after_power_on_and_each_reset(
    board: Board, host: Host
) -> None:
    """So a host that did not notice the reset, and still sends speeds, cannot move the robot."""
    for _ in range(2):
        stays_off(board, 400)
        for line in (speeds_line(DRIVE), speeds_line((0.0, 0.0, 0.0, 0.01))):
            host.send(line)
            assert host.says(b"").startswith(BOOTED), "each refused line is answered so"
        stays_off(board, 50)
        host.stop()
        host.write(speeds_line(DRIVE))
        stays_off(board, 50)  # not yet a whole line
        host.write(b"\r\n")
        passes(board, 30)
        assert board.status().running
        board.command("reset")
        assert is_off(board.status())
        host.says(BOOTED)


def test_the_motors_are_off_300_ms_after_the_last_valid_line(board: Board, host: Host) -> None:
    took = []
    for _ in range(3):
        host.drive(DRIVE, 0.25)
        assert board.status().running
        passes(board, 400)
        took.append(off_after(board))
    print(f"silence -> motors off: {min(took):.1f} to {max(took):.1f} ms")
    assert 290 <= min(took) <= max(took) <= 320
    host.drive(STOPPED, 0.3)
    stays_off(board, 100)


def test_lines_that_come_without_a_pause_do_not_restart_the_board(board: Board, host: Host) -> None:
    host.drive(DRIVE, 0.2)
    before = board.status()
    for _ in range(60):
        host.write((speeds_line(DRIVE) + b"\r\n") * 10)
        passes(board, 28)
        host.lines()
    after = board.status()
    assert (after.running, after.resets) == (True, before.resets)


BAD_LINES = [
    b"", b"hello", b"ap10.00", b"ap10.00,bp10.00,cp10.00", b"ap10.00,bp10.00,cp10.00,",
    b"ap10.00,ap10.00,cp10.00,dp10.00", b"ap10.00,bp10.00,cp10.00,dp100.00",
    b"ap10.00,bp10.00,cp10.00,dp10", b"\x00ap10.00,bp10.00,cp10.00,dp10.00",
    b" ap10.00,bp10.00,cp10.00,dp10.00", b"ap10.00,bp10.00,cp10.00,dp10.00 ",
    b"ap10.00,bp10.00,cp10.00,dp99.999", b"ap10.00,bp10.00,cp10.00,dp10.00#07",
    b"ap10.00,bp10.00,cp10.00,dp10.00#07*0000", b"ap10.00;bp10.00;cp10.00;dp10.00",
    b"ap10.0\x00,bp10.00,cp10.00,dp10.00", b"\xff" * 200, b"??", b"!",
]  # fmt: skip


def test_only_a_whole_valid_line_moves_a_motor_is_answered_or_feeds_the_watchdog(
    board: Board, host: Host
) -> None:
    host.stop()
    for line in BAD_LINES:
        host.send(line)
    stays_off(board, 200)
    assert host.lines() == []
    host.drive(DRIVE, 0.3)
    fed = board.status().heard_ns
    for line in (BAD_LINES[-5], BAD_LINES[3], b"?") * 12:
        host.send(line)
        passes(board, 12)
    took = (board.status().off_ns - fed) / MS
    print(f"off {took:.1f} ms after the last good line, although others came")
    assert 290 <= took <= 320


def test_each_line_is_answered_once_and_in_time(board: Board, host: Host) -> None:
    host.stop()
    took = []
    for _ in range(100):
        (reply,) = host.drive(DRIVE, 0.01)
        assert len(reply.line) == len(STOP)
        took.append(board.status().answer_ns / MS)
    print(f"line end -> first byte of the answer: {min(took):.2f} to {max(took):.2f} ms")
    assert max(took) < 5.0


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b",\r\n"])
def test_the_line_ends_that_hosts_send_are_accepted(board: Board, host: Host, end: bytes) -> None:
    host.stop()
    host.send(speeds_line(DRIVE), end)
    passes(board, 30)
    assert board.status().running


@pytest.mark.parametrize("speeds", [DRIVE, (-1.0, 2.0, -40.0, 0.5)])
def test_a_commanded_speed_is_reached_and_reported(
    board: Board, host: Host, speeds: Speeds
) -> None:
    host.drive(speeds, 1.0)
    replies = host.drive(speeds, 0.5)
    for motor, wanted in enumerate(speeds):
        reports = [reply.speeds[motor] for reply in replies]
        true = board.status().motors[motor].speed
        mean, noise = statistics.mean(reports), statistics.pstdev(reports)
        print(f"{'abcd'[motor]}: wanted {wanted}, turns {true:.3f}, says {mean:.3f} +- {noise:.3f}")
        assert true == pytest.approx(wanted, rel=0.02, abs=0.05)
        assert mean == pytest.approx(wanted, rel=0.01, abs=0.05)


def test_a_bridge_changes_its_direction_only_without_voltage(board: Board, host: Host) -> None:
    """A driver with one direction input reverses when that input falls."""
    for way in (1, -1) * 3:
        host.drive((30.0 * way, -30.0 * way, 20.0, -40.0 * way), 0.3)
    passes(board, 400)
    assert [motor.flip_duty for motor in board.status().motors] == [0.0] * 4


def test_a_reset_is_seen_if_the_program_hangs(runner: Path, firmware: Path, tmp_path: Path) -> None:
    """The sketch feeds the hardware watchdog no longer than 1 s. (C firmware: test_board.)"""
    hanging = build_sketch(tmp_path, ("wdt_reset();", "if (millis() < 1000) wdt_reset();"))
    with Board(runner, hanging) as board, board.in_steps(), Host(board.path, board) as host:
        host.plain = True
        host.drive(DRIVE, 0.8)
        assert board.status().running
        passes(board, 500)
        assert board.status().resets == 1
        host.send(speeds_line(DRIVE))
        stays_off(board, 100)


@pytest.mark.parametrize("sketched", [False, True], ids=["firmware", "sketch"])
def test_a_pressed_emergency_stop_is_off_reported_and_kept_until_zeros(
    runner: Path, wired: dict[int, Path], wired_sketch: Path, sketched: bool
) -> None:
    program = wired_sketch if sketched else wired[115200]
    with Board(runner, program) as board, board.in_steps(), Host(board.path, board) as host:

        def drives() -> bool:
            for _ in range(10):
                host.send(speeds_line(DRIVE))
                passes(board, 10)
            return board.status().running

        board.command(f"contact {ESTOP} closed")
        passes(board, 50)
        host.stop()
        assert drives()
        assert b" estop=ok" in host.says(b"!status")
        board.command(f"contact {ESTOP} open")
        assert not drives()
        status = board.status()
        off, said = (at - status.contact_ns for at in (status.off_ns, status.reported_ns))
        print(f"pressed -> off after {off / MS:.1f} ms, on the line after {said / MS:.1f} ms")
        assert 0 < off <= (12 if sketched else 5) * MS
        assert 0 < said <= (12 if sketched else 10) * MS
        host.send(STOP)
        assert not drives(), "zeros count only after the release"
        board.command(f"contact {ESTOP} closed")
        passes(board, 50)
        assert not drives()
        host.send(STOP)
        assert drives()


@pytest.mark.nightly
def test_the_check_passes_the_sketch(runner: Path, sketch: Path) -> None:
    with Board(runner, sketch, "--free-speed", FREE_SPEEDS) as board:
        ended = typed("mcu", "check", "--port", board.path, "--yes", "--wheels-are-lifted")
    assert ended.code == 0, ended.out


MEASURE = """
void setup() { prepare(); }
void loop() {
  static unsigned long most, count, began;
  unsigned long at = micros();
  turn();
  most = max(most, micros() - at), count++;
  if (at - began < 500000) return;
  Serial.print(F("# ")), Serial.print(most), Serial.print(' '), Serial.println(500000 / count);
  most = count = 0, began = micros();
}
"""


@pytest.mark.parametrize(("speed", "most_us"), [(10.0, 4000), (20.0, 7000)])
def test_the_loop_of_the_sketch_is_shorter_than_its_tick(
    runner: Path, firmware: Path, tmp_path: Path, speed: float, most_us: int
) -> None:
    """At 20 rad/s, 3200 counts a turn are 41 edges a millisecond of all wheels."""
    renamed = ("void setup()", "void prepare()"), ("void loop()", "void turn()")
    measured = build_sketch(tmp_path, *renamed, more=MEASURE)
    with Board(runner, measured) as board, board.in_steps(), Host(board.path, board) as host:
        host.stop()
        told = b""
        for _ in range(250):
            host.send(speeds_line((speed, -speed, speed, -speed)))
            passes(board, 10)
            told = next((line for _, line in host.lines() if line[:1] == b"#"), told)
        longest, mean = map(int, told.split()[1:])
        print(f"{speed} rad/s: the loop takes {mean} us, {longest} us at the most")
        assert longest < most_us
