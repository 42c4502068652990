"""A robot is driven; the tests check the lines to the MCU and the messages on the bus."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from acsard.core.config.settings import (
    Config,
    DriveConfig,
    McuConfig,
    WheelMap,
)
from acsard.core.messages.schema import Beat, JointState, TFMessage, TwistStamped
from acsard.core.values import NS_PER_S
from tests.scenarios.world import World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_two_seconds_at_half_a_metre_per_second_is_one_metre(world: World) -> None:
    world.drive(0.5, seconds=2.0)
    world.send(0.0)
    world.run(1.0)
    assert world.odom.pose.pose.position.x == pytest.approx(1.0, rel=0.02)
    assert world.mcu.vehicle.pose.x == pytest.approx(1.0, rel=0.02)


def test_the_first_line_of_a_session_is_zero(world: World) -> None:
    assert world.mcu.heard[0][1] == b"\r\n"
    assert world.lines()[0] == b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def test_half_a_metre_per_second_is_ten_rad_per_second_on_every_wheel(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.lines()[-1] == b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


def test_a_left_turn_runs_the_right_wheels_forward_and_the_left_ones_back(world: World) -> None:
    world.drive(0.0, 1.0, seconds=1.0)
    assert world.lines()[-1] == b"ap03.00,bn03.00,cn03.00,dp03.00\r\n"
    assert world.state.yaw > 0


@pytest.mark.slow
def test_a_full_circle_comes_back_to_its_start(world: World) -> None:
    world.drive(0.5, 1.0, seconds=2 * math.pi)
    world.send(0.0)
    world.run(2.0)
    true, state = world.mcu.vehicle.pose, world.state
    assert math.hypot(state.x - true.x, state.y - true.y) < 0.02
    assert math.remainder(state.yaw - true.yaw, math.tau) == pytest.approx(0.0, abs=0.02)


@pytest.mark.slow
def test_one_line_goes_out_every_period(world: World) -> None:
    before = len(world.port.sent)
    world.run(10.0)
    assert len(world.port.sent) - before == 1000
    assert {b[0] - a[0] for a, b in pairwise(list(world.port.sent)[-1000:])} == {10_000_000}


def test_every_message_of_a_sample_has_its_stamp(world: World) -> None:
    world.bus.wanted_keys |= {"odom", "tf", "wheel_states"}
    world.drive(0.5, seconds=0.5)
    published = world.bus.published
    for odom, tf, wheels in zip(
        published["odom"], published["tf"], published["wheel_states"], strict=True
    ):
        assert isinstance(tf, TFMessage)
        assert isinstance(wheels, JointState)
        stamp = msgspec.structs.asdict(odom)["header"].stamp
        assert tf.transforms[0].header.stamp == stamp == wheels.header.stamp


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


def test_the_applied_speed_ramps_by_the_acceleration(world: World) -> None:
    world.bus.wanted_keys.add("cmd_vel_out")
    world.drive(0.5, seconds=1.0)
    twists = world.bus.published["cmd_vel_out"]
    lines = [
        (t.header.stamp.to_ns() / NS_PER_S, t.twist.linear.x)
        for t in twists
        if isinstance(t, TwistStamped)
    ]
    rates = [(v - u) / (t - s) for (s, u), (t, v) in pairwise(lines)]
    assert max(rates) == pytest.approx(1.0, rel=1e-4)
    assert lines[-1][1] == 0.5


def test_silence_begins_a_ramp_within_the_timeout_and_a_tick(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    last_command_ns = world.now_ns - 50_000_000
    world.run(1.0)
    full = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"
    last_full_ns = max(at for at, line in world.port.sent if line == full)
    assert 0 <= last_full_ns + 10_000_000 - last_command_ns <= 250_000_000 + 10_000_000
    assert world.lines()[-1] == b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def test_no_wheel_speeds_up_while_the_robot_brakes_out_of_an_arc(world: World) -> None:
    world.drive(0.9, 3.0, seconds=2.0)
    speeds: list[tuple[float, ...]] = []
    world.watch = lambda outputs: speeds.append(outputs.speeds.as_tuple())
    world.run(0.25)
    world.run(2.0)
    falling = speeds[60:]
    for before, after in pairwise(falling):
        assert all(abs(b) <= abs(a) + 1e-12 for a, b in zip(before, after, strict=True))
    assert falling[-1] == (0.0, 0.0, 0.0, 0.0)


def test_a_command_above_the_limits_is_scaled_and_keeps_its_curvature(world: World) -> None:
    world.drive(5.0, 5.0, seconds=2.0)
    applied = world.outputs
    assert applied is not None
    assert applied.applied.linear == pytest.approx(1.0)
    assert applied.applied.angular == pytest.approx(1.0)


def test_wheels_can_be_commanded_by_name_in_any_order(world: World) -> None:
    names = list(reversed(world.config.joints.as_tuple()))
    for speed in (*[0.0] * 24, *[10.0] * 40):
        payload = msgspec.msgpack.encode({"name": names, "velocity": [speed] * 4})
        world.put("wheel_cmd/ros2_control", payload)
        world.run(0.05)
    assert world.lines()[-1] == b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"
    assert world.state.source == "ros2_control"


def test_a_reversed_motor_changes_the_sign_of_command_and_feedback_once() -> None:
    world = World(Config(mcu=McuConfig(wheels=WheelMap(front_left="-a", front_right="+b"))))
    world.run(0.2)
    world.drive(0.5, seconds=1.0)
    assert world.lines()[-1] == b"an10.00,bp10.00,cp10.00,dp10.00\r\n"
    assert world.state.wheels[1] == pytest.approx(10.0, abs=0.3)


def test_slip_is_undone_by_the_wheel_separation_multiplier() -> None:
    world = World(Config(drive=DriveConfig(wheel_separation_multiplier=1.25)))
    # The vehicle's own track contains the multiplier; remove it, as slip of the real base.
    world.mcu.vehicle.turn_slip = 0.0
    world.run(0.2)
    world.drive(0.0, 1.0, seconds=3.0)
    world.send(0.0)
    world.run(1.0)
    assert world.state.yaw == pytest.approx(math.remainder(3.0, math.tau), abs=0.03)
    assert world.mcu.vehicle.pose.yaw == pytest.approx(world.state.yaw, abs=0.03)
