"""The check measures when replies arrive, and the highest speed of the configured limits."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import pytest
from msgspec.structs import replace

from acsard.checkup import dialect, lateness, line_loss, procedure, reply_times, top_speed
from acsard.checkup.findings import Finding, StoppedError, motor_name
from acsard.checkup.motor_channels import Channel, channel, wheel_map
from acsard.checkup.restarts import RestartedError
from acsard.core.config.settings import Config, LimitsConfig, SimConfig
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, MS, Checked, Robot, check
from tests.unit.test_checkup_lines import ByItsOwnClock

VALUE = re.compile(rb"([pn])(\d\d\.\d\d)")
TOP = 20.0


def lagging(seconds: float) -> Config:
    return Config(sim=SimConfig(motor_time_constant=seconds))


class Reported(Robot):
    """A robot whose firmware reports other speeds than it measures."""

    def __init__(self, change: Callable[[float], float], config: Config | None = None) -> None:
        super().__init__("plain_only", config=config)
        self._change = change

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        return [(at_ns, VALUE.sub(self._value, data)) for at_ns, data in super().listen(until_ns)]

    def _value(self, match: re.Match[bytes]) -> bytes:
        speed = self._change(float(match[2]) * (1 if match[1] == b"p" else -1))
        return f"{'n' if speed < 0 else 'p'}{abs(speed):05.2f}".encode()


def overflowing(speed: float) -> float:
    return (speed + 12.8) % 25.6 - 12.8


@FOUR_AND_TWO
@each(
    ("change", "code"),
    [
        (lambda speed: speed, "top_speed_reached"),
        (overflowing, "top_speed_overflow"),
        (lambda speed: min(speed, 11.0), "top_speed_short"),
    ],
)
def test_the_speeds_up_to_that_of_the_limits_are_compared(
    change: Callable[[float], float], code: str, config: Config
) -> None:
    robot = Reported(change, config)
    with robot.board() as board:
        found = top_speed.finding(board, range(len(board.letters)), None, TOP, 0.05)
        assert max(map(abs, robot.mcu.vehicle.speeds)) < 0.1
        assert board.most_speed == 6.0
    assert found.code == code
    if code == "top_speed_short":
        for motor in range(len(board.letters)):
            assert motor_name(board.mcu, motor) in found.text
    if code == "top_speed_overflow":
        assert "10.0 rad/s" in found.text
    said = found.text + found.mend
    for speed, linear in re.findall(r"([\d.]+) rad/s, which is ([\d.]+) m/s", said):
        assert float(linear) == pytest.approx(0.05 * float(speed), abs=0.01)


def fastest(robot: Robot) -> float:
    return max(float(value) for line in robot.sent for _, value in VALUE.findall(line))


@each(
    ("faults", "fast", "code"),
    [
        (("no_watchdog",), True, "top_speed_no_watchdog"),
        (("late_watchdog",), True, "top_speed_no_watchdog"),
        (("toggled_direction",), True, "top_speed_damaged_lines"),
        ((), False, "top_speed_not_chosen"),
        ((), True, "top_speed_reached"),
    ],
)
def test_only_a_sound_board_is_driven_fast_and_only_if_a_person_chose_the_speed(
    faults: tuple[str, ...], fast: bool, code: str
) -> None:
    robot = Robot("plain_only", *faults)
    checked = Checked(robot, fast=fast)
    assert checked["top speed"].code == code
    assert (fastest(robot) > 3.0) is (code == "top_speed_reached")


def test_a_watchdog_or_damaged_lines_that_were_not_judged_are_not_sound() -> None:
    for late in (lateness.finding("watchdog", 0.1), None):
        assert not procedure._sound(late)
    assert procedure._sound(Finding("damaged lines", "PASS"))


def test_a_motor_that_is_backward_from_the_start_is_not_driven_faster_and_is_no_overflow() -> None:
    robot = Robot("plain_only", "toggled_direction")
    with robot.board() as board:
        board.wire.send(f"{board.letters[0]}n\r\n".encode())
        board.stop_motors()
        found = top_speed.finding(board, [0, 1], None, TOP, 0.05)
    assert found.code == "top_speed_backward"
    assert "motor a" in found.text
    assert "overflow" not in found.text
    assert fastest(robot) == 3.0


def test_a_runaway_is_judged_by_the_speed_of_the_step_until_the_motors_stand() -> None:
    robot = Reported(lambda speed: 4 * speed if speed > 15 else speed)
    with robot.board() as board:
        with pytest.raises(StoppedError) as end:
            top_speed.finding(board, [0], None, TOP, 0.05)
        assert "more than 30 rad/s" in end.value.finding.text


@each(("gain", "code"), [(3.0, "runaway_along"), (-3.0, "runaway_against")])
@each("speed", [3.0, -3.0])
def test_a_runaway_goes_with_its_command_or_against_it(
    gain: float, code: str, speed: float
) -> None:
    robot = Reported(lambda measured: gain * measured)
    with robot.board() as board, pytest.raises(StoppedError) as end:
        board.drive(board.only([1], speed), 1.0)
    assert end.value.finding.code == code
    assert "motor b" in end.value.finding.name + end.value.finding.text


def test_a_restart_at_high_speed_leaves_the_high_bound_until_the_motors_stand() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        board.abort_check = lambda: resets(robot)
        with pytest.raises(RestartedError):
            top_speed.finding(board, [0], None, TOP, 0.05)
        assert board.most_speed == 1.5 * TOP
        board.abort_check = lambda: None
        board.forget()
        assert board.comes_back()
        board.stop_motors()
        assert board.most_speed == 6.0


def resets(robot: Robot) -> None:
    if robot.mcu.vehicle.speeds[0] > 15.0:
        robot.mcu.reset(robot.now_ns(), 300 * MS)


@each("seconds", [0.02, 0.05, 0.1])
@each(
    ("robot", "faults"),
    [
        (Robot, ("free_running",)),
        (ByItsOwnClock, ("free_running",)),
        (Robot, ("sparse_replies",)),
        (ByItsOwnClock, ("sparse_replies",)),
    ],
)
def test_seldom_reports_of_a_right_board_are_not_taken_for_wrong_directions(
    robot: type[Robot], faults: tuple[str, ...], seconds: float
) -> None:
    with robot(*faults, "plain_only", config=lagging(seconds)).board() as board:
        dialect.rate(board)
        for motor in (0, 1):
            assert channel(board, motor).kind != "last edge"


@each("seconds", [0.03, 0.05])
def test_directions_of_the_last_edge_are_found(seconds: float) -> None:
    with Robot("free_running", "last_edge", config=lagging(seconds)).board() as board:
        dialect.rate(board)
        assert channel(board, 0).kind == "last edge"


class Blocking(Robot):
    """A firmware whose loop stands still for `block_s` in each `every_s`, and then answers all."""

    def __init__(self, block_s: float, every_s: float) -> None:
        super().__init__("plain_only")
        self._block_ns, self._held = int(block_s * 1e9), list[bytes]()
        self._every_ns = int(every_s * 1e9)

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        pieces = []
        for at_ns, data in super().listen(until_ns):
            if at_ns % self._every_ns < self._block_ns:
                self._held.append(data)
                continue
            pieces += [(at_ns + n * MS // 2, held) for n, held in enumerate(self._held)]
            pieces.append((at_ns + len(self._held) * MS // 2, data))
            self._held.clear()
        return pieces


@each(
    ("block_s", "every_s", "code"),
    [
        (0.0, 0.5, "reply_times_even"),
        (0.01, 0.5, "reply_times_even"),
        (0.015, 0.1, "reply_times_even"),  # each tenth reply, but no longer than two periods
        (0.08, 0.5, "reply_times_bunched"),
        # Most gaps are those inside a bunch.
        (0.06, 0.1, "reply_times_bunched"),
        (0.08, 0.1, "reply_times_bunched"),
    ],
)
def test_replies_behind_silences_come_in_bunches(block_s: float, every_s: float, code: str) -> None:
    with Blocking(block_s, every_s).board() as board:
        board.paced = True
        found = reply_times.finding(board)
    assert found is not None
    assert found.code == code
    if code == "reply_times_bunched":
        assert float(found.figure.split("max ")[1].split()[0]) > 900 * block_s - 5


@each(
    ("block_s", "code"),
    [(0.0, "lost_lines_none"), (0.075, "lost_lines_none"), (0.12, "lost_lines_late")],
)
def test_a_silence_that_the_daemon_takes_for_a_lost_link_is_named(
    block_s: float, code: str
) -> None:
    with Blocking(block_s, 0.5).board() as board:
        board.paced, board.gap_s = True, 0.01
        assert line_loss.finding(board).code == code


def answered(wheels: Sequence[str | None], **faulty: int) -> list[Channel]:
    """Return channels of four sound motors with these answers, some of them with a fault."""
    channels = []
    for motor, wheel in enumerate(wheels):
        forth = tuple(3.0 * (n == motor) for n in range(4))
        back = tuple(-speed for speed in forth)
        if motor in faulty.values():
            forth, back = back, forth
        channels.append(Channel(motor, forth, back, wheel))
    return channels


OWN = ("front_right", "front_left", "rear_left", "rear_right")


@each(
    ("wheels", "faulty", "code"),
    [
        (OWN, {}, "wheel_map_right"),
        (OWN, {"c": 2}, "wheel_map_right"),
        ((*OWN[:2], "rear_right", "rear_left"), {}, "wheel_map_other"),
        ((*OWN[:2], "front_left", "front_right"), {"c": 2, "d": 3}, "wheel_map_faulty"),
        ((None, *OWN[1:]), {}, "wheel_map_partly"),
        ((None,) * 4, {}, "wheel_map_not_seen"),
        ((*OWN[:3], "front_right"), {}, "wheel_map_twice"),
    ],
)
def test_no_answer_of_a_person_is_dropped(
    wheels: tuple[str | None, ...], faulty: dict[str, int], code: str
) -> None:
    found = wheel_map(Config().mcu, answered(wheels, **faulty))
    assert found.code == code
    if code == "wheel_map_faulty":
        assert "motor c turn the front left wheel" in found.text
        assert not found.keys


@each("gain", [0.35, 1.0])
def test_motors_that_turn_too_slowly_show_the_watchdog_too(gain: float) -> None:
    faults = [f"bias={letter}:{gain}" for letter in "abcd"]
    checked = check("plain_only", *faults)
    assert checked["watchdog"].code in ("watchdog_right", "watchdog_unclear")
    assert checked["damaged lines"].verdict == "PASS"
    fast = checked["top speed"].code
    assert fast == ("top_speed_reached" if gain == 1.0 else "top_speed_untested")
    assert check("plain_only", "no_watchdog", *faults)["watchdog"].verdict == "FAIL"


def test_the_check_of_a_slow_robot_does_not_go_beyond_its_limits() -> None:
    limits = replace(LimitsConfig(), linear_speed=0.1, angular_speed=0.1)
    robot = Robot("plain_only", config=Config(limits=limits))
    checked = Checked(robot)
    assert checked["top speed"].verdict == "PASS"
    assert not checked.failed
