"""What each firmware for the robot promises: the C firmware, and the Arduino sketch on two chips.

The machine code runs in a simulator, and the times are those of the board. All lines are plain.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.firmware.board import (
    DRIVE,
    MEGA,
    MS,
    STOP,
    UNO,
    Board,
    Chip,
    Host,
    Speeds,
    read_reply,
    speeds_line,
)
from tests.firmware.conftest import ESTOP, FREE_SPEEDS
from tests.system.typed import typed

pytestmark = pytest.mark.firmware

STOPPED: Speeds = (0.0, 0.0, 0.0, 0.0)

BOOTED = b"!acsard-mcu "


@pytest.fixture(params=[None, MEGA, UNO], ids=["firmware", "sketch", "sketch, two motors"])
def host(
    runner: Path, firmware: Path, sketch: Callable[..., Path], request: pytest.FixtureRequest
) -> Iterator[Host]:
    program = sketch(request.param) if request.param else firmware
    options = "--free-speed", FREE_SPEEDS, *on(request.param)
    with Board(runner, program, *options) as board, Host(board, True) as host:
        yield host


def on(chip: Chip | None) -> tuple[str, ...]:
    """Return the runner's options for a chip with the sketch, or for the C firmware's board."""
    return ("--board", chip.board, "--counts", "1600") if chip else ()


def test_motors_are_off_until_zeros_have_come_after_power_on_and_each_reset(host: Host) -> None:
    """So a host that did not notice the reset, and still sends speeds, cannot move the robot."""
    board = host.board
    for _ in range(2):
        board.stays_off(400)
        for line in (host.line(DRIVE), host.line((0.0, 0.01, 0.0, 0.0))):
            host.send(line)
            assert host.says(b"").startswith(BOOTED), "each refused line is answered so"
        board.stays_off(50)
        host.stop()
        host.write(host.line(DRIVE))
        board.stays_off(50)  # not yet a whole line
        host.write(b"\r\n")
        assert board.passes(30).running
        board.command("reset")
        assert board.status().is_off
        host.says(BOOTED)


def test_the_motors_are_off_300_ms_after_the_last_valid_line(host: Host) -> None:
    took = []
    for _ in range(3):
        host.drive(DRIVE, 0.25)
        assert host.board.status().running
        status = host.board.passes(400)
        assert status.is_off
        took.append((status.off_ns - status.heard_ns) / MS)
    print(f"silence -> motors off: {min(took):.1f} to {max(took):.1f} ms")
    assert 290 <= min(took) <= max(took) <= 320
    status = host.board.is_still()
    host.drive(STOPPED, 0.3)
    assert host.board.status().on_ns == status.on_ns, "not for a moment"


def test_an_integral_wound_up_before_a_stop_does_not_drive_the_robot_after_it(host: Host) -> None:
    board = host.board
    motors = "abcd"[: board.motors]
    for motor in motors:
        board.command(f"load {motor} 1")
    host.drive((20.0, 20.0, 20.0, 20.0), 0.6)
    true = board.status().motors[: board.motors]
    assert all(motor.duty == 1.0 for motor in true), "as hard as they can"
    status = board.passes(400)
    host.drive(STOPPED, 0.3)
    assert board.status().on_ns == status.on_ns, "not for a moment"
    for motor in motors:
        board.command(f"load {motor} 0")
    host.drive((2.0, 2.0, 2.0, 2.0), 0.1)
    assert max(host.turns()) < 6.0


def test_lines_that_come_without_a_pause_are_obeyed_and_do_not_restart_the_board(
    host: Host,
) -> None:
    board = host.board
    host.drive(DRIVE, 0.2)
    resets, answers = board.status().resets, 0
    for _ in range(60):
        host.write((host.line(DRIVE) + b"\r\n") * 10)
        answers += len(host.lines(28))
    status = board.status()
    assert (status.running, status.resets) == (True, resets)
    assert answers > 300
    assert host.turns() == pytest.approx(DRIVE[: board.motors], rel=0.02)


def bad_lines(host: Host) -> list[bytes]:
    """Return lines that no board may obey, the first six of them with a whole number of values."""
    good, last = host.line((10.0,) * 4), b"abcd"[host.board.motors - 1 :][:1] + b"p"
    cut = good[:-7]
    return [
        good[:-8], good[:-7], b"ap10.00," * (host.board.motors - 1) + b"ap10.00",
        cut + last + b"10", b"", b"hello", b"ap10.00", cut + last + b"100.00",
        b"\x00" + good, b" " + good, good + b" ", cut + last + b"99.999", good + b"#07",
        good + b"#07*0000", good.replace(b",", b";"), b"ap10.0\x00" + good[7:], b"\xff" * 200,
        good + b",ep10.00", b"??", b"!",
    ]  # fmt: skip


def test_only_a_whole_valid_line_moves_a_motor_is_answered_or_feeds_the_watchdog(
    host: Host,
) -> None:
    host.stop()
    bad = bad_lines(host)
    for line in bad:
        host.send(line)
    host.board.stays_off(200)
    assert host.lines() == []
    host.drive(DRIVE, 0.3)
    fed = host.board.status().heard_ns
    for line in (bad[14], bad[0], b"?") * 12:
        host.send(line)
        host.board.passes(12)
    took = (host.board.status().off_ns - fed) / MS
    print(f"off {took:.1f} ms after the last good line, although others came")
    assert 290 <= took <= 320


def test_each_line_is_answered_once_and_in_time(host: Host) -> None:
    host.stop()
    took = []
    for _ in range(100):
        (reply,) = host.drive(DRIVE, 0.01)
        assert len(reply.line) == len(host.zeros)
        took.append(host.board.status().answer_ns / MS)
    print(f"line end -> first byte of the answer: {min(took):.2f} to {max(took):.2f} ms")
    assert max(took) < 5.0


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b",\r\n"])
def test_the_line_ends_that_hosts_send_are_accepted(host: Host, end: bytes) -> None:
    host.stop()
    host.send(host.line(DRIVE), end)
    assert host.board.passes(30).running


@pytest.mark.parametrize("speeds", [DRIVE, (-1.0, 2.0, -40.0, 0.5)])
def test_a_commanded_speed_is_reached_and_reported(host: Host, speeds: Speeds) -> None:
    host.drive(speeds, 1.0)
    replies = host.drive(speeds, 0.5)
    for motor, wanted in enumerate(speeds[: host.board.motors]):
        reports = [reply.speeds[motor] for reply in replies]
        true = host.board.status().motors[motor].speed
        mean, noise = statistics.mean(reports), statistics.pstdev(reports)
        print(f"{'abcd'[motor]}: wanted {wanted}, turns {true:.3f}, says {mean:.3f} +- {noise:.3f}")
        assert true == pytest.approx(wanted, rel=0.02, abs=0.05)
        assert mean == pytest.approx(wanted, rel=0.01, abs=0.05)


def test_a_bridge_changes_its_direction_only_without_voltage(host: Host) -> None:
    """A driver with one direction input reverses when that input falls."""
    for way in (1, -1) * 3:
        host.drive((30.0 * way, -30.0 * way, 20.0, -40.0 * way), 0.3)
    assert [motor.flip_duty for motor in host.board.passes(400).motors] == [0.0] * 4


@pytest.mark.parametrize("chip", [MEGA, UNO])
def test_a_reset_is_seen_if_the_program_hangs(
    runner: Path, sketch: Callable[..., Path], chip: Chip
) -> None:
    """The sketch feeds the hardware watchdog no longer than 1 s. (C firmware: test_board.)"""
    hanging = sketch(chip, ("  feed();", "  if (millis() < 1000) feed();"))
    with Board(runner, hanging, *on(chip)) as board, Host(board, True) as host:
        host.drive(DRIVE, 0.8)
        assert board.status().running
        assert board.passes(500).resets == 1
        host.send(host.line(DRIVE))
        board.stays_off(100)


@pytest.mark.parametrize("sketched", [False, True], ids=["firmware", "sketch"])
def test_a_pressed_emergency_stop_is_off_reported_and_kept_until_zeros(
    runner: Path, wired: dict[int, Path], sketch: Callable[..., Path], sketched: bool
) -> None:
    program = sketch(MEGA, ("ESTOP = -1", f"ESTOP = {ESTOP}")) if sketched else wired[115200]
    options = on(MEGA if sketched else None)
    with Board(runner, program, *options) as board, Host(board, True) as host:

        def drives() -> bool:
            host.drive(DRIVE, 0.1)
            return board.status().running

        board.command(f"contact {ESTOP} closed")
        board.passes(50)
        host.stop()
        assert drives()
        assert b" estop=ok" in host.says(b"!status")
        board.command(f"contact {ESTOP} open")
        assert not drives()
        status = board.status()
        off, said = (at - status.contact_ns for at in (status.off_ns, status.reported_ns))
        print(f"pressed -> off after {off / MS:.1f} ms, on the line after {said / MS:.1f} ms")
        assert 0 < off <= (12 if sketched else 5) * MS
        assert 0 < said <= 12 * MS
        host.send(STOP)
        assert not drives(), "zeros count only after the release"
        board.command("reset")
        host.says(BOOTED)
        host.send(STOP)
        assert not drives(), "nor if it was pressed at the boot"
        board.command(f"contact {ESTOP} closed")
        board.passes(50)
        assert not drives()
        host.send(STOP)
        assert drives()


def test_an_encoder_that_counts_backward_is_declared_in_the_sketch(
    runner: Path, sketch: Callable[..., Path]
) -> None:
    declared = sketch(UNO, ("WAY[] = {1, 1, 1, 1}", "WAY[] = {-1, 1, 1, 1}"))
    with Board(runner, declared, *on(UNO)) as board, Host(board, True) as host:
        board.command("encoder a swapped")
        host.drive((8.0, -5.0, 0.0, 0.0), 1.0)
        assert host.turns() == pytest.approx([8.0, -5.0], rel=0.02)
        board.command("reset")
        host.says(BOOTED)
        host.stop()
        host.drive((8.0, -5.0, 0.0, 0.0), 1.0)
        assert host.turns() == pytest.approx([8.0, -5.0], rel=0.02)


def test_encoders_with_too_many_edges_for_the_chip_do_not_compile(
    sketch: Callable[..., Path],
) -> None:
    with pytest.raises(AssertionError, match="Too many edges a second"):
        sketch(MEGA, ("COUNTS_PER_TURN = 800", "COUNTS_PER_TURN = 1600"))


def test_the_sketch_for_two_motors_obeys_and_sends_two_values(
    runner: Path, sketch: Callable[..., Path]
) -> None:
    two = sketch(MEGA, ("MOTORS = 4", "MOTORS = 2"))
    with Board(runner, two, "--free-speed", FREE_SPEEDS, *on(MEGA)) as board, Host(board) as host:
        for line in (STOP, speeds_line(DRIVE), b"ap10.00,bn05.00"):
            host.send(line)
        board.stays_off(50)  # neither four zeros nor speeds before two zeros
        host.lines()
        host.send(b"ap00.00,bp00.00")
        for _ in range(100):
            host.send(b"ap10.00,bn05.00")
            *_, reply = host.lines(10)
        # A count in 10 ms is 0.8 rad/s.
        assert read_reply(reply).speeds == pytest.approx([10.0, -5.0], abs=1.0)
        speeds = [motor.speed for motor in board.status().motors]
        assert speeds == pytest.approx([10.0, -5.0, 0.0, 0.0], rel=0.02)
        for _ in range(40):
            host.send(speeds_line(DRIVE))
            host.board.passes(10)
        assert board.status().is_off, "four values do not feed the watchdog"


@pytest.mark.nightly
@pytest.mark.parametrize("chip", [MEGA, UNO])
def test_the_check_passes_the_sketch(
    runner: Path, sketch: Callable[..., Path], chip: Chip, tmp_path: Path
) -> None:
    config = tmp_path / "robot.toml"
    config.write_text("" if chip is MEGA else '[mcu.wheels]\nleft = "+b"\nright = "+a"\n')
    with Board(runner, sketch(chip), "--free-speed", FREE_SPEEDS, *on(chip), live=True) as board:
        words = ["--config", str(config), "--port", board.path, "--yes", "--wheels-are-lifted"]
        ended = typed("mcu", "check", *words)
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


@pytest.mark.parametrize("chip", [MEGA, UNO])
def test_the_loop_of_the_sketch_is_shorter_than_its_tick(
    runner: Path, sketch: Callable[..., Path], chip: Chip
) -> None:
    """Each wheel makes 800 edges of channel A in a turn: at 50 rad/s 6.4 in a millisecond."""
    renamed = ("void setup()", "void prepare()"), ("void loop()", "void turn()")
    measured = sketch(chip, *renamed, more=MEASURE)
    fast = ("--free-speed", "55,55,55,55")
    with Board(runner, measured, *fast, *on(chip)) as board, Host(board) as host:
        host.stop()
        for speed, most_us in ((10.0, 4000), (45.0, 7000)):
            told = b""
            for _ in range(250):
                host.send(host.line((speed, -speed, speed, -speed)))
                told = next((line for line in host.lines(10) if line[:1] == b"#"), told)
            longest, mean = map(int, told.split()[1:])
            print(f"{speed} rad/s: the loop takes {mean} us, {longest} us at the most")
            assert longest < most_us
            assert [abs(turned) for turned in host.turns()] == pytest.approx(
                [speed] * board.motors, rel=0.02
            )
