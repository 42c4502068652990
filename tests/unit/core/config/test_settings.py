"""Tests of the configuration keys: their defaults, and both ends of their ranges."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from acsard.core.config.settings import (
    Config,
    ControlConfig,
    JointsConfig,
    McuConfig,
    Source,
    WheelMap,
)
from acsard.core.config.validation import build
from acsard.core.values import WHEELS
from tests.each import each
from tests.unit.keys import KEYS, Key

NUMBERS = [key for key in KEYS if key.numbers()]
FLOATS = [key for key in NUMBERS if isinstance(key.numbers()[0], inspect.FloatType)]


def accepts(key: Key, value: float) -> bool:
    """Return whether the key's own range accepts `value`."""
    table: dict[str, Any] = {key.field.name: value}
    if key.table is Source:
        table = {"name": "x", "priority": 1} | table
    return build(key.table, table, "t", []) is not None


def test_the_defaults_are_those_of_the_original_robot() -> None:
    config = Config()
    assert config.robot.id == "acsar"
    assert config.mcu.port == "sim"
    assert config.mcu.baud_rate == 115200
    assert config.drive.wheel_radius == 0.05
    assert config.drive.wheel_separation == 0.30
    assert config.odometry.odom_frame == "odom"
    assert config.odometry.base_frame == "base_link"
    assert config.lidar.lidar_frame == "lidar_link"
    assert {s.name for s in config.commands.sources if s.neutral_first == "pause"} == {"nav"}


def test_the_default_limits_are_those_of_the_design() -> None:
    limits = Config().limits
    assert (limits.linear_speed, limits.angular_speed) == (1.0, 4.0)
    assert (limits.linear_acceleration, limits.angular_acceleration) == (1.0, 4.0)
    assert (limits.linear_deceleration, limits.angular_deceleration) == (1.0, 4.0)
    assert (limits.linear_stop_deceleration, limits.angular_stop_deceleration) == (3.0, 12.0)
    assert (limits.linear_jerk, limits.angular_jerk) == (0.0, 0.0)


def test_the_default_sources_are_ranked_teleop_app_ros2_control_dock_nav() -> None:
    assert [(s.name, s.priority, s.timeout) for s in Config().commands.sources] == [
        ("teleop", 100, 0.25),
        ("app", 50, 0.25),
        ("ros2_control", 20, 0.25),
        ("dock", 15, 0.25),
        ("nav", 10, 0.25),
    ]


def test_the_bus_is_loopback_only_and_not_on_the_port_of_routers() -> None:
    bus = Config().bus
    assert bus.listen == ("tcp/127.0.0.1:7448",)
    assert bus.connect == ()
    assert not bus.insecure


def test_the_wheel_map_and_the_joints_have_the_four_wheels_in_the_standard_order() -> None:
    assert WheelMap.__struct_fields__ == WHEELS
    assert JointsConfig.__struct_fields__ == WHEELS
    assert JointsConfig().as_tuple() == tuple(f"{wheel}_wheel_joint" for wheel in WHEELS)
    assert JointsConfig("fr", "fl", "rl", "rr").as_tuple() == ("fr", "fl", "rl", "rr")


def test_every_table_is_frozen() -> None:
    assert all(key.table.__struct_config__.frozen for key in KEYS)
    assert Config.__struct_config__.frozen


@each("key", NUMBERS)
def test_every_number_has_a_range_that_includes_its_bounds(key: Key) -> None:
    (kind, *_) = key.numbers()
    assert kind.ge is not None
    assert kind.le is not None
    assert accepts(key, kind.ge)
    assert accepts(key, kind.le)


@each("key", NUMBERS)
def test_no_number_beyond_its_range_is_accepted(key: Key) -> None:
    (kind, *_) = key.numbers()
    assert kind.ge is not None
    assert kind.le is not None
    if isinstance(kind, inspect.IntType):
        beyond: tuple[float, float] = (kind.ge - 1, kind.le + 1)
    else:
        beyond = (math.nextafter(kind.ge, -math.inf), math.nextafter(kind.le, math.inf))
    assert not accepts(key, beyond[0])
    assert not accepts(key, beyond[1])


@each("key", FLOATS)
def test_the_ranges_themselves_are_finite(key: Key) -> None:
    assert all(
        math.isfinite(kind.ge or 0) and math.isfinite(kind.le or 0) for kind in key.numbers()
    )


@each("key", KEYS)
def test_every_default_is_a_valid_value_of_its_key(key: Key) -> None:
    if not key.field.required:
        assert msgspec.convert(key.field.default, key.field.type, strict=True) == key.field.default


@pytest.mark.parametrize("name", ["a", "A-z_0", "x" * 32])
def test_a_name_is_letters_digits_underscore_and_minus(name: str) -> None:
    assert build(Source, {"name": name, "priority": 1}, "t", []) is not None


@each("name", ["", "x" * 33, "a b", "a/b", "*", "**", "$*", "é", "a.b", "#", "?"])
def test_a_name_with_characters_that_are_special_in_keys_is_refused(name: str) -> None:
    assert build(Source, {"name": name, "priority": 1}, "t", []) is None


@each("frame", ["", "/odom", "a b", "x" * 65, "é", "a-b"])
def test_a_frame_name_that_tf2_would_refuse_is_refused(frame: str) -> None:
    assert build(JointsConfig, {"front_left": frame}, "t", []) is None


def test_a_frame_name_may_have_a_prefix() -> None:
    assert build(JointsConfig, {"front_left": "robot1/front_left"}, "t", []) is not None


@each("baud", [300, 14400, 230400, 0, -9600])
def test_a_baud_rate_that_the_board_does_not_support_is_refused(baud: int) -> None:
    assert build(McuConfig, {"baud_rate": baud}, "t", []) is None


def test_a_numeric_control_rate_is_used_unchanged() -> None:
    assert Config(control=ControlConfig(rate=50)).rate_hz == 50.0


@each(
    ("baud", "trailing_comma", "rate"),
    [
        (9600, False, 23.0),
        (9600, True, 22.0),
        (19200, False, 46.0),
        (38400, False, 93.0),
        (38400, True, 90.0),
        (57600, False, 100.0),
        (115200, False, 100.0),
    ],
)
def test_an_automatic_rate_uses_at_most_80_percent_of_the_wire(
    baud: Any, trailing_comma: bool, rate: float
) -> None:
    mcu = McuConfig(baud_rate=baud, trailing_comma=trailing_comma)
    assert Config(mcu=mcu, control=ControlConfig(rate="auto")).rate_hz == rate
