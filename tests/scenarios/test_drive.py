"""A robot is driven; the tests check the lines to the MCU and the messages on the bus."""

from __future__ import annotations

import math

import msgspec
import pytest

from acsard.core.config.settings import (
    Config,
    DriveConfig,
    McuConfig,
    WheelMap,
)
from acsard.core.messages.schema import Beat, JointState, TFMessage
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


def test_half_a_metre_per_second_is_ten_rad_per_second_on_every_wheel(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.lines()[-1] == b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


def test_a_left_turn_runs_the_right_wheels_forward_and_the_left_ones_back(world: World) -> None:
    world.drive(0.0, 1.0, seconds=1.0)
    assert world.lines()[-1] == b"ap03.00,bn03.00,cn03.00,dp03.00\r\n"
    assert world.state.yaw > 0


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


def test_silence_begins_a_ramp_within_the_timeout_and_a_tick(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    last_command_ns = world.now_ns - 50_000_000
    world.run(1.0)
    full = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"
    last_full_ns = max(at for at, line in world.port.sent if line == full)
    assert 0 <= last_full_ns + 10_000_000 - last_command_ns <= 250_000_000 + 10_000_000
    assert world.lines()[-1] == b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


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
