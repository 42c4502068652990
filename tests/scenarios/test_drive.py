"""A drive from the command to the pose, and lines between two periods."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from acsard.core.config.settings import (
    Config,
    McuConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.messages.schema import Beat
from tests.scenarios.world import World
from tests.wheels import FOUR, STEADY, TWO, four_and_two


@pytest.fixture
def wheels() -> WheelMap:
    return FOUR


@pytest.fixture
def world(wheels: WheelMap) -> World:
    world = World(Config(mcu=McuConfig(wheels=wheels), limits=STEADY))
    world.run(0.2)
    world.send(0.0)
    world.run(0.05)
    return world


@four_and_two
def test_two_seconds_at_half_a_metre_per_second_is_one_metre(
    world: World, wheels: WheelMap
) -> None:
    world.drive(0.5, seconds=2.0)
    assert world.state.wheels == pytest.approx([10.0] * len(wheels.names), abs=0.3)
    world.send(0.0)
    world.run(1.0)
    assert world.odom.pose.pose.position.x == pytest.approx(1.0, rel=0.02)
    assert world.mcu.vehicle.pose.x == pytest.approx(1.0, rel=0.02)


def test_a_beat_has_the_time_of_each_twentieth_of_a_second_while_somebody_subscribes(
    world: World,
) -> None:
    world.run(1.0)
    assert "beat" not in world.bus.published
    world.bus.wanted_keys.add("beat")
    began_us = world.now_ns // 1000
    world.run(1.0)
    beats = [beat.boot_us for beat in world.bus.published["beat"] if isinstance(beat, Beat)]
    expected = [beats[0] + 50_000 * number for number in range(20)]
    assert beats == pytest.approx(expected, abs=3000)
    assert beats[0] - began_us <= 10_000


def test_silence_begins_a_ramp_within_the_timeout_and_a_tick(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    last_command_ns = world.now_ns - 50_000_000
    world.run(1.0)
    full = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"
    last_full_ns = max(at for at, line in world.port.sent if line == full)
    assert 0 <= last_full_ns + 10_000_000 - last_command_ns <= 250_000_000 + 10_000_000
    assert world.lines()[-1] == b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


@pytest.mark.parametrize(
    ("wheels", "line"),
    [
        (WheelMap(), b"ap10.00,bp05.00,cp05.00,dp10.00\r\n"),
        (WheelMap(left="+l", right="+r"), b"lp05.00,rp10.00\r\n"),
    ],
)
def test_wheels_can_be_commanded_by_name_in_any_order(wheels: WheelMap, line: bytes) -> None:
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    names = list(reversed(world.config.joint_names))
    for speed in (*[0.0] * 24, *[10.0] * 40):
        speeds = [speed if "right" in name else speed / 2 for name in names]
        payload = msgspec.msgpack.encode({"name": names, "velocity": speeds})
        world.put("wheel_cmd/ros2_control", payload)
        world.run(0.05)
    assert world.lines()[-1] == line
    assert world.state.source == "ros2_control"


@pytest.mark.parametrize(
    ("wheels", "line"),
    [
        (WheelMap(front_left="-a", front_right="+b"), b"an10.00,bp10.00,cp10.00,dp10.00\r\n"),
        (WheelMap(left="-l", right="+r"), b"ln10.00,rp10.00\r\n"),
        (WheelMap(left="-z", right="+b"), b"bp10.00,zn10.00\r\n"),
    ],
)
def test_a_reversed_motor_changes_the_sign_of_command_and_feedback_once(
    world: World, line: bytes
) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.lines()[-1] == line
    assert world.state.wheels[1] == pytest.approx(10.0, abs=0.3)
    world.drive(0.0, 1.0, seconds=1.0)
    assert world.state.wheels[:2] == pytest.approx([3.0, -3.0], abs=0.3)
    assert world.mcu.vehicle.pose.yaw == pytest.approx(world.state.yaw, abs=0.03)


# A fresh command does not wait for the next period, and adds no lines to those of the periods


MS = 1_000_000
GAP_NS = 3_864_583
"""The time of 33 bytes at 115200 baud, and a millisecond."""


def sent_after(world: World, at_ns: int) -> list[int]:
    """Return the times in ns from `at_ns` to each line that the daemon has sent since then."""
    return [sent - at_ns for sent, _ in world.port.sent if sent >= at_ns]


def between_ticks(world: World, ms: float) -> None:
    """Run until `ms` after the start of the next control period."""
    world.run((world.next_period_ns - world.now_ns) / 1e9)
    world.run(ms / 1e3)


def test_a_fresh_command_is_sent_between_periods_without_delay(world: World) -> None:
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.send(0.5)
    assert sent_after(world, at_ns) == [0]
    assert world.port.sent[-1][1] != world.port.sent[-2][1]


def test_a_command_right_after_a_line_waits_for_the_minimum_gap_and_no_longer(world: World) -> None:
    between_ticks(world, 1.0)
    at_ns = world.now_ns
    world.send(0.5)
    world.run(0.008)
    assert sent_after(world, at_ns) == [GAP_NS - 1 * MS]


@pytest.mark.parametrize("hz", [30.0, 99.0, 333.0, 1000.0, 5000.0])
def test_no_rate_of_commands_makes_more_lines_than_periods(world: World, hz: float) -> None:
    at_ns = world.now_ns
    world.hold(0.5, seconds=1.0, hz=hz)
    lines = sent_after(world, at_ns)
    assert 99 <= len(lines) <= 102, "a hundred, and one more at either end"
    assert min(b - a for a, b in pairwise(lines)) >= GAP_NS


@pytest.mark.parametrize("speed", [0.4, 0.0])
def test_a_repeated_speed_has_no_line_of_its_own(world: World, speed: float) -> None:
    world.drive(speed)
    between_ticks(world, 0.0)
    at_ns = world.now_ns
    world.hold(speed, seconds=1.0, hz=19.0)
    assert {late_ns % (10 * MS) for late_ns in sent_after(world, at_ns)} == {0}
    assert world.state.mode == "driving"


def test_a_stop_is_sent_between_periods_too(world: World) -> None:
    world.hold(0.5, seconds=1.0)
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.put("stop", b"")
    assert sent_after(world, at_ns) == [0]
    assert world.state.mode == "stopped"


def test_a_command_that_does_not_count_sends_no_early_line(world: World) -> None:
    world.hold(0.5, seconds=0.5, source="teleop")
    world.send(0.0, source="nav")
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    for _ in range(10):
        world.send(-0.5, source="nav")
        world.put("cmd/stranger", b"{}")
    world.run(0.0039)
    assert sent_after(world, at_ns) == []


def test_the_reported_latencies_of_a_command_are_the_real_ones(world: World) -> None:
    between_ticks(world, 1.0)
    world.send(0.5)
    world.run(1.1)
    figures = world.state.latencies
    waited = figures["command_to_wire"].since_start
    assert waited.max == pytest.approx((GAP_NS - 1 * MS) / 1000)
    assert figures["mcu_round_trip"].since_start.count == 0, (
        "a plain reply does not name the line that it answers"
    )
    assert figures["period_lateness"].since_start.max == 0.0


def test_the_wait_of_a_command_includes_the_lines_that_could_not_leave(world: World) -> None:
    world.hold(0.3, seconds=0.5)
    between_ticks(world, 6.0)
    world.port.blocked = True
    world.send(0.5)
    world.run(0.020)
    world.port.blocked = False
    world.run(1.1)
    assert world.state.latencies["command_to_wire"].since_start.max >= 20_000.0


def test_checked_replies_give_the_round_trip_time_of_the_microcontroller() -> None:
    world = World(Config(mcu=McuConfig(link_check="on")))
    world.run(1.0)
    round_trip = world.state.latencies["mcu_round_trip"].since_start
    assert round_trip.count > 50
    assert 6_700 <= round_trip.p50 <= 12_000


@pytest.mark.slow
def test_the_course_robot_drives_and_turns_with_all_its_faults() -> None:
    """At each reversal its board gives a whole report the sign of its last edge."""
    faults = "free_running", "comma_latched", "no_watchdog", "last_edge", "toggled_direction"
    world = World(
        Config(
            mcu=McuConfig(wheels=TWO, trailing_comma=True, reply_period=0.1),
            limits=STEADY,
            sim=SimConfig(faults=faults, encoder_counts=385),
        )
    )
    world.run(0.3)
    world.send(0.0)
    world.run(0.05)
    for _ in range(20):
        world.drive(0.3, 0.2, seconds=1.0)
        world.drive(-0.3, seconds=0.5)
        world.send(0.0)
        world.run(1.0)
    truth, pose = world.mcu.vehicle.pose, world.odom.pose.pose.position
    error_m = math.hypot(pose.x - truth.x, pose.y - truth.y)
    print(f"20 reversals: {error_m * 1000:.1f} mm, {world.state.yaw - truth.yaw:+.4f} rad")
    assert error_m < 0.02
    assert world.state.yaw == pytest.approx(truth.yaw, abs=0.02)
    assert world.state.code == "no_command"
