"""The payload of each channel matches the channel's message definition.

A program that knows only the definition can decode the payload.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from mcap_ros2._vendor.rosidl_adapter.parser import parse_message_string
from msgspec import Struct, inspect
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.core.messages.cdr_types import plain
from acsard.core.messages.schema import Header, Time, Twist, TwistStamped, Vector3
from acsard.core.ros.channels import (
    ACSARD_PREFIX,
    BY_KEY,
    CHANNELS,
    CMD_VEL_IN,
    DEFINITIONS,
    LOG_CHANNEL,
    SEPARATOR_LINE,
    STATE_CHANNEL,
    Channel,
    nested,
    published_channels,
    schema_text,
)
from acsard.core.ros.names import TYPE_HASHES
from acsard.core.ros.shapes import log
from acsard.core.ros.transports import PUBLISHED
from acsard.core.values import Event
from tests.each import each
from tests.unit.core.ros.test_names import rihs01
from tests.unit.core.ros.test_shapes import STATE as ROBOT_STATE


def filled(cls: type[Struct]) -> Any:
    """Return a message in which no two fields are equal."""
    counted = iter(range(1, 1000))

    def value(kind: inspect.Type) -> Any:
        match plain(kind):
            case inspect.StructType(cls=inner):
                info = inspect.type_info(inner)
                assert isinstance(info, inspect.StructType)
                return inner(*[value(field.type) for field in info.fields])
            case inspect.ListType(item_type=item, min_length=least):
                return [value(item) for _ in range(least or 2)]
            case inspect.UnionType(types=(number, _)):
                return value(number)
            case inspect.BoolType():
                return True
            case inspect.FloatType():
                return next(counted) / 8
            case inspect.StrType():
                return f"text {next(counted)}"
            case _:
                return next(counted)

    return value(inspect.type_info(cls))


def same(ours: Any, theirs: Any) -> bool:
    """Return whether two messages have equal fields in the same order."""
    if isinstance(ours, Struct):
        fields = [getattr(ours, name) for name in ours.__struct_fields__]
        others = [v for k, v in vars(theirs).items() if k != "__msgtype__" and not k.isupper()]
        return len(fields) == len(others) and all(map(same, fields, others))
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    return bool(ours == theirs) or (isinstance(ours, float) and math.isnan(ours))


@pytest.mark.slow
@each("channel", CHANNELS)
def test_each_channel_is_encoded_as_its_definition_says(channel: Channel) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel.schema, channel.schema_name))
    message = filled(channel.message)
    assert same(message, store.deserialize_cdr(channel.encode(message), channel.schema_name))


def test_a_robot_state_is_read_back_from_its_encoding_unchanged() -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(STATE_CHANNEL.schema, STATE_CHANNEL.schema_name))
    read: Any = store.deserialize_cdr(STATE_CHANNEL.encode(ROBOT_STATE), STATE_CHANNEL.schema_name)
    assert (read.mode, read.x, read.header.stamp.sec) == ("driving", 1.0, 5)
    assert [source.name for source in read.sources] == ["app", "nav"]


def test_topics_have_the_names_of_the_ros_tree() -> None:
    assert {row.native: row.name for row in PUBLISHED}.items() <= {
        key: channel.name for key, channel in BY_KEY.items()
    }.items()
    assert BY_KEY["wheel_states"].topic("robot1") == "/robot1/joint_states"
    assert CMD_VEL_IN.topic("", "app") == "/cmd_vel_in/app"


def test_a_key_that_the_robot_does_not_publish_has_no_channel() -> None:
    assert set(CHANNELS) - set(published_channels(frozenset({"tf"}))) == {BY_KEY["tf"]}


def test_events_and_commands_have_a_channel_beside_the_keys() -> None:
    twist = TwistStamped(Header(Time(1)), Twist(Vector3(x=0.5), Vector3()))
    assert LOG_CHANNEL.encode(log(Event("started", "up"), Time())).startswith(b"\0\1\0\0")
    assert len(CMD_VEL_IN.encode(twist)) == 68


THEIRS = [name for name in DEFINITIONS if not name.startswith(ACSARD_PREFIX)]


@each("name", DEFINITIONS)
def test_a_schema_text_contains_every_type_that_it_needs(name: str) -> None:
    assert {name, *nested(name)} == set(get_types_from_msg(schema_text(name), name))


@each("name", THEIRS)
def test_another_program_computes_the_same_hash_from_the_schema_text(name: str) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema_text(name), name))
    known = TYPE_HASHES.get(name, rihs01(name))
    assert store.hash_rihs01(name) == known == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)


@each("name", THEIRS)
def test_a_schema_text_has_the_constants_of_ros(name: str) -> None:
    jazzy = get_typestore(Stores.ROS2_JAZZY).fielddefs
    constants, _ = get_types_from_msg(schema_text(name), name)[name]
    assert constants == jazzy[name][0]


def test_the_default_quaternion_is_the_identity_rotation() -> None:
    first, *_ = schema_text("geometry_msgs/msg/Quaternion").split(SEPARATOR_LINE)
    read = parse_message_string("geometry_msgs", "Quaternion", first)
    assert {field.name: field.default_value for field in read.fields} == {
        "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0
    }  # fmt: skip


def test_a_schema_text_has_the_type_first_and_then_each_needed_type_once() -> None:
    text = schema_text("nav_msgs/msg/Odometry")
    first, *others = text.split(f"{SEPARATOR_LINE}\nMSG: ")
    assert first == (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    )
    assert [other.partition("\n")[0] for other in others] == [
        "std_msgs/Header", "builtin_interfaces/Time",
        "geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose", "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
        "geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist", "geometry_msgs/Vector3",
    ]  # fmt: skip
