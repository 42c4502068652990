"""The check measures when replies arrive, and the highest speed of the configured limits."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from msgspec.structs import replace

from acsard.checkup import reply_times, top_speed
from acsard.checkup.motor_channels import Channel, wheel_map
from acsard.core.config.settings import Config, LimitsConfig
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, MS, Checked, Robot, check

VALUE = re.compile(rb"([pn])(\d\d\.\d\d)")
TOP = 20.0


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
        found = top_speed.finding(board, range(len(board.letters)), True, TOP, 0.05)
        assert max(map(abs, robot.mcu.vehicle.speeds)) < 0.1
        assert board.most_speed == 6.0
    assert found.code == code
    if code == "top_speed_overflow":
        assert "10.0 rad/s" in found.text


def test_a_board_without_a_watchdog_is_not_driven_fast() -> None:
    with Robot("no_watchdog").board() as board:
        assert top_speed.finding(board, [0], False, TOP, 0.05).code == "top_speed_no_watchdog"
        assert top_speed.finding(board, [], True, TOP, 0.05).code == "top_speed_untested"


class Blocking(Robot):
    """A firmware whose loop stands still for `block_s` twice a second, and then answers all."""

    def __init__(self, block_s: float) -> None:
        super().__init__("plain_only")
        self._block_ns, self._held = int(block_s * 1e9), list[bytes]()

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        pieces = []
        for at_ns, data in super().listen(until_ns):
            if at_ns % (500 * MS) < self._block_ns:
                self._held.append(data)
                continue
            pieces += [(at_ns + n * MS // 2, held) for n, held in enumerate(self._held)]
            pieces.append((at_ns + len(self._held) * MS // 2, data))
            self._held.clear()
        return pieces


@each(
    ("block_s", "code"),
    [(0.0, "reply_times_even"), (0.01, "reply_times_even"), (0.08, "reply_times_bunched")],
)
def test_a_firmware_that_blocks_its_loop_answers_in_bunches(block_s: float, code: str) -> None:
    with Blocking(block_s).board() as board:
        board.paced = True
        found = reply_times.finding(board)
    assert found is not None
    assert found.code == code
    if code == "reply_times_bunched":
        assert float(found.figure.split("max ")[1].split()[0]) > 70


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


@each("gain", [0.35, 0.4, 0.6, 1.0])
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
