"""Tests of the log and `state` as ROS messages."""

from __future__ import annotations

import math
from typing import Any

from msgspec.structs import replace
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import LogEvent, RobotState, SourceState, Time
from acsard.core.ros.channels import STATE_CHANNEL as CHANNEL
from acsard.core.ros.shapes import Counter, Log, Source, State, log, state
from acsard.core.values import Event

STORE = get_typestore(Stores.EMPTY)
STORE.register(get_types_from_msg(CHANNEL.schema, CHANNEL.schema_name))

STATE = RobotState(
    stamp=Time(5, 6),
    mode="driving",
    reason="commanded by app",
    x=1.0,
    y=2.0,
    yaw=0.5,
    linear=0.3,
    angular=0.1,
    wheels=[1.0, 2.0, 3.0, 4.0],
    link="up",
    source="app",
    sources=[
        SourceState("app", 50, 0.1, "", "nothing"),
        SourceState("nav", 10, None, "a command", "command"),
    ],
    refused="",
    counters={"lines": 7, "commands": 2},
    sender="joystick",
    feedback_age=0.01,
    emergency_stop="released",
    bumpers=[False, True],
)


def test_an_event_is_a_log_line_of_ros() -> None:
    event = Event("command_refused", "3 x stale; the last: too old", "warning", "a phone", count=3)
    text = "3 x stale; the last: too old (by a phone)"
    at = Time(1, 500_000_000)
    assert log(event, at) == Log(at, 30, "command_refused", text)


def test_an_event_of_the_topic_gives_the_same_log_line() -> None:
    event = LogEvent(Time(1), "fault", "error", "dead motor", "", 1)
    assert log(event, event.stamp) == log(Event("fault", "dead motor", "error"), Time(1))


def test_a_log_line_without_actor_or_repetition_has_the_text_alone() -> None:
    assert log(Event("started", "up"), Time()) == Log(Time(), 20, "started", "up")


def test_a_source_without_commands_has_no_age() -> None:
    assert state(STATE).sources == [
        Source("app", 50, 0.1, "", "nothing"), Source("nav", 10, None, "a command", "command")
    ]  # fmt: skip


def test_null_fields_of_the_state_are_nan_in_ros() -> None:
    none = replace(STATE, linear=None, angular=None, wheels=[], feedback_age=None, bumpers=None)
    unknown = state(none)
    message: Any = STORE.deserialize_cdr(Cdr(State).encode(unknown), CHANNEL.schema_name)
    assert all(map(math.isnan, (message.linear, message.angular, message.feedback_age)))
    assert math.isnan(message.sources[1].age)
    assert (len(message.wheels), len(message.bumpers), message.x) == (0, 0, 1.0)
    assert Cdr(State).decode(Cdr(State).encode(unknown)) == unknown


def test_the_ros_state_equals_the_native_state_field_by_field() -> None:
    message = state(STATE)
    assert message.header.stamp == STATE.stamp
    assert message.counters == [Counter("lines", 7), Counter("commands", 2)]
    plain = set(message.__struct_fields__) - {"header", "sources", "counters"}
    assert all(getattr(message, name) == getattr(STATE, name) for name in plain)
    left_out = set(STATE.__struct_fields__) - set(message.__struct_fields__)
    # A ROS Trigger has no field for the numbers of causes, and diagnostics report the latch file.
    # An exported recording does not contain the configuration file, and the robot that a replay
    # makes knows no speed limit, only the setting that it lowers. The battery has its own topic. An
    # export has the version in its metadata.
    assert left_out == {
        "stamp", "latencies", "encoder_counts", "causes", "latch_file_error", "settings_differ",
        "speed_limit", "battery", "certificate_days", "certificate", "version",
    }  # fmt: skip
