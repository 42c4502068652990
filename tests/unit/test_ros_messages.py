"""A program that knows only the definition of a channel reads its messages, judged by rosbags."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec import Struct, inspect
from msgspec.structs import astuple, replace
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.core.messages.cdr import Cdr
from acsard.core.messages.cdr_types import plain
from acsard.core.messages.schema import (
    Header,
    LogEvent,
    RobotState,
    SourceState,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.ros.channels import (
    ACSARD_PREFIX,
    BY_KEY,
    CHANNELS,
    CMD_VEL_IN,
    DEFINITIONS,
    STATE_CHANNEL,
    Channel,
    RosState,
    nested,
    published_channels,
    schema_text,
    state,
)
from acsard.core.ros.shapes import Log, log
from acsard.core.ros.transports import PUBLISHED
from acsard.core.values import Event
from tests.each import each

STATE = RobotState(
    stamp=Time(5, 6), mode="driving", reason="commanded by app", x=1.0, y=2.0, yaw=0.5,
    linear=0.3, angular=0.1, wheels=[1.0, 2.0, 3.0, 4.0], link="up", source="app",
    sources=[
        SourceState("app", 50, 0.1, "", "nothing", 0.3, 0.1, 0.2),
        SourceState("nav", 10, 0.3, "a command", "command", 0.1, -0.2, 0.7),
    ],
    refused="", counters={"lines": 7, "commands": 2}, sender="joystick", feedback_age=0.01,
    emergency_stop="released", bumpers=[False, True],
)  # fmt: skip


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


def read(channel: Channel, payload: bytes) -> Any:
    """Return the message that rosbags reads with the definition of a channel."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel.schema, channel.schema_name))
    return store.deserialize_cdr(payload, channel.schema_name)


@pytest.mark.slow
@each("channel", CHANNELS)
def test_each_channel_is_encoded_as_its_definition_says(channel: Channel) -> None:
    message = filled(channel.message)
    assert same(message, read(channel, channel.encode(message)))


def test_topics_have_the_names_of_the_ros_tree() -> None:
    names = {key: channel.name for key, channel in BY_KEY.items()}
    assert {row.native: row.name for row in PUBLISHED}.items() <= names.items()
    assert BY_KEY["wheel_states"].topic("robot1") == "/robot1/joint_states"
    assert CMD_VEL_IN.topic("", "app") == "/cmd_vel_in/app"
    assert set(CHANNELS) - set(published_channels(frozenset({"tf"}))) == {BY_KEY["tf"]}
    twist = TwistStamped(Header(Time(1)), Twist(Vector3(x=0.5), Vector3()))
    assert len(CMD_VEL_IN.encode(twist)) == 68


@each("name", DEFINITIONS)
def test_a_schema_text_has_every_type_that_it_needs_and_the_constants_of_ros(name: str) -> None:
    types = get_types_from_msg(schema_text(name), name)
    assert {name, *nested(name)} == set(types)
    if not name.startswith(ACSARD_PREFIX):
        assert types[name][0] == get_typestore(Stores.ROS2_JAZZY).fielddefs[name][0]


# the log and the state


@each(
    ("event", "line"),
    [
        (Event("command_refused", "3 x stale; the last: too old", "warning", "a phone", count=3),
         Log(Time(1, 5), 30, "command_refused", "3 x stale; the last: too old (by a phone)")),
        (Event("started", "up"), Log(Time(1, 5), 20, "started", "up")),
        (LogEvent(Time(1, 5), "fault", "error", "dead motor", "", 1),
         Log(Time(1, 5), 40, "fault", "dead motor")),
    ],
)  # fmt: skip
def test_an_event_is_a_log_line_of_ros(event: Any, line: Log) -> None:
    assert log(event, Time(1, 5)) == line


def test_the_ros_state_has_the_values_of_the_native_state() -> None:
    message: Any = state(STATE)
    assert message.header.stamp == STATE.stamp
    assert [astuple(counter) for counter in message.counters] == [("lines", 7), ("commands", 2)]
    assert [*map(astuple, message.sources)] == [*map(astuple, STATE.sources)]
    plain = set(message.__struct_fields__) - {"header", "sources", "counters"}
    assert all(getattr(message, name) == getattr(STATE, name) for name in plain)
    left_out = set(STATE.__struct_fields__) - set(message.__struct_fields__)
    # A ROS Trigger has no field for the numbers of causes, and diagnostics report the latch file.
    # An exported recording does not contain the configuration file, and the robot that a replay
    # makes knows no speed limit, only the setting that it lowers. The battery has its own topic. An
    # export has the version in its metadata.
    wanted = {
        "stamp", "latencies", "encoder_counts", "causes", "latch_file_error", "settings_differ",
        "speed_limit", "battery", "certificate_days", "certificate", "version",
    }  # fmt: skip
    assert left_out == wanted, (
        f"add {left_out ^ wanted} to the state of ROS in core/ros, or to this list"
    )


def test_null_fields_of_the_state_are_nan_in_ros() -> None:
    silent = [SourceState("app", 50, None, "", "nothing")]
    none = replace(
        STATE,
        linear=None,
        angular=None,
        wheels=[],
        feedback_age=None,
        bumpers=None,
        sources=silent,
    )
    unknown = state(none)
    message = read(STATE_CHANNEL, STATE_CHANNEL.encode(none))
    numbers = (message.linear, message.angular, message.feedback_age, message.sources[0].linear)
    assert all(map(math.isnan, numbers))
    assert (len(message.wheels), len(message.bumpers), message.x) == (0, 0, 1.0)
    assert Cdr(RosState).decode(Cdr(RosState).encode(unknown)) == unknown
