"""The structs on the bus have the shape and names of their ROS 2 messages."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.messages import schema
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import MESSAGES, JointState, Message, Quaternion, Time, Vector3
from tests.each import each

STRUCTS = [
    thing
    for thing in vars(schema).values()
    if isinstance(thing, type) and issubclass(thing, Message) and thing is not Message
]

ROS_FIELDS: dict[str, tuple[str, ...]] = {
    "Time": ("sec", "nanosec"),
    "Header": ("stamp", "frame_id"),
    "Vector3": ("x", "y", "z"),
    "Quaternion": ("x", "y", "z", "w"),
    "Twist": ("linear", "angular"),
    "TwistStamped": ("header", "twist"),
    "Pose": ("position", "orientation"),
    "Imu": (
        "header", "orientation", "orientation_covariance", "angular_velocity",
        "angular_velocity_covariance", "linear_acceleration", "linear_acceleration_covariance",
    ),
    "PoseStamped": ("header", "pose"),
    "PoseWithCovariance": ("pose", "covariance"),
    "TwistWithCovariance": ("twist", "covariance"),
    "Odometry": ("header", "child_frame_id", "pose", "twist"),
    "Transform": ("translation", "rotation"),
    "TransformStamped": ("header", "child_frame_id", "transform"),
    "TFMessage": ("transforms",),
    "JointState": ("header", "name", "position", "velocity", "effort"),
    "KeyValue": ("key", "value"),
    "DiagnosticStatus": ("level", "name", "message", "hardware_id", "values"),
    "DiagnosticArray": ("header", "status"),
}  # fmt: skip
"""Fields in order, from the .msg files of common_interfaces and rcl_interfaces (ROS 2 Jazzy)."""


@each(("name", "names"), ROS_FIELDS.items())
def test_a_message_has_the_fields_of_its_ros_message_in_the_same_order(
    name: str, names: tuple[str, ...]
) -> None:
    assert getattr(schema, name).__struct_fields__ == names


@each("cls", STRUCTS)
def test_every_message_is_frozen(cls: type[Message]) -> None:
    assert cls.__struct_config__.frozen


def test_every_message_of_the_bus_is_registered_under_its_name() -> None:
    assert all(cls.__name__ == name for name, cls in MESSAGES.items())
    parts = {"Time", "Header", "Vector3", "Quaternion", "Pose", "PoseWithCovariance"}
    parts |= {"TwistWithCovariance", "Transform", "TransformStamped", "SourceState", "KeyValue"}
    parts |= {"DiagnosticStatus", "HardwareInterface", "TopicInfo", "Spread", "Latency", "LogEvent"}
    parts |= {"BatterySummary", "Cause", "Change", "ReplyData"}
    assert set(MESSAGES) == {cls.__name__ for cls in STRUCTS} - parts


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_time_is_whole_seconds_and_the_nanoseconds_of_the_rest(wall_ns: int) -> None:
    time = Time.from_ns(wall_ns)
    assert 0 <= time.nanosec < 1_000_000_000
    assert time.sec * 1_000_000_000 + time.nanosec == wall_ns
    assert time.to_ns() == wall_ns


@pytest.mark.parametrize(("wall_s", "sec"), [(2**31, 2**31 - 1), (-(2**31) - 1, -(2**31))])
def test_a_time_outside_the_range_of_ros_is_clamped(wall_s: int, sec: int) -> None:
    time = Time.from_ns(wall_s * 10**9)
    assert time.sec == sec
    assert Cdr(Time).decode(Cdr(Time).encode(time)) == time


def test_a_time_is_converted_to_and_from_nanoseconds() -> None:
    assert Time.from_ns(1_700_000_003_250_000_001) == Time(1_700_000_003, 250_000_001)
    assert Time(3, 5).to_ns() == 3_000_000_005


def test_the_default_quaternion_is_no_rotation() -> None:
    assert Quaternion() == Quaternion(0.0, 0.0, 0.0, 1.0)


def test_two_joint_states_do_not_share_their_lists() -> None:
    JointState().name.append("x")
    assert JointState().name == []


@each("text", [b'{"x": "1"}', b'{"x": null}', b'{"x": true}'])
def test_a_vector_with_invalid_fields_is_refused(text: bytes) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(text, type=Vector3)


@each("cls", MESSAGES.values())
def test_every_message_has_a_json_schema_with_all_its_fields(cls: type[Message]) -> None:
    (components,) = msgspec.json.schema_components([cls])[1:]
    properties: Any = components[cls.__name__]["properties"]
    assert tuple(properties) == cls.__struct_fields__
