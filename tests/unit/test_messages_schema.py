"""The JSON Schemas say what a message has and what is accepted. A third-party validator judges."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, McuConfig, OdometryConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.incoming.imu import GyroFollower
from acsard.core.incoming.queries import interfaces, topic_table
from acsard.core.link.link_state import TRANSITIONS as LINKS
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.encodings import DecodeError, encode
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import PUBLISHED, TOPICS
from acsard.core.messages.report import Report
from acsard.core.messages.schema import (
    MESSAGES,
    Beat,
    Info,
    Message,
    ServiceReply,
    Time,
)
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.modes import Mode
from acsard.core.values import GyroDoes, Role
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, STATUS, due


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_time_is_whole_seconds_and_the_nanoseconds_of_the_rest(wall_ns: int) -> None:
    time = Time.from_ns(wall_ns)
    assert 0 <= time.nanosec < 1_000_000_000
    assert time.sec * 1_000_000_000 + time.nanosec == time.to_ns() == wall_ns


@pytest.mark.parametrize(("wall_s", "sec"), [(2**31, 2**31 - 1), (-(2**31) - 1, -(2**31))])
def test_a_time_outside_the_range_of_ros_is_clamped(wall_s: int, sec: int) -> None:
    time = Time.from_ns(wall_s * 10**9)
    assert time.sec == sec
    assert Cdr(Time).decode(Cdr(Time).encode(time)) == time


# JSON Schemas

INCOMING = {
    "Twist", "TwistStampedIn", "JointStateIn", "ImuIn", "SetPose", "Release", "SwitchOff",
    "Settings", "GatewayState", "SpeedLimit",
}  # fmt: skip


def parts(name: str) -> list[dict[str, Any]]:
    """Return the schema and all its nested schemas that have fields."""
    found = SCHEMAS[name]
    return [part for part in (found, *found["$defs"].values()) if "properties" in part]


def refused(name: str, value: object) -> list[str]:
    """Return the validator's objections to a value."""
    return [error.message for error in Draft202012Validator(SCHEMAS[name]).iter_errors(value)]


def as_json(message: Message) -> Any:
    return msgspec.json.decode(encode(message, "json"))


@pytest.mark.slow
@each("name", SCHEMAS)
def test_each_schema_is_valid_in_its_dialect_and_has_a_unique_id(name: str) -> None:
    found = SCHEMAS[name]
    assert found["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    assert (found["$id"], found["title"]) == (f"urn:acsard:{name}.v1", name)
    Draft202012Validator.check_schema(found)


@each("name", SCHEMAS)
def test_outgoing_messages_have_all_fields_and_incoming_ones_no_others(name: str) -> None:
    """A later version may add fields to what it sends. A misspelt field of a command is refused."""
    assert parts(name)
    for part in parts(name):
        if name in INCOMING:
            assert part["additionalProperties"] is False
        else:
            assert part["required"] == list(part["properties"])
            assert "additionalProperties" not in part


def test_the_incoming_and_outgoing_schemas_are_those_of_the_topic_table() -> None:
    """An incoming type gets the suffix `In` if it is published too."""
    types = {topic.direction: set[str]() for topic in TOPICS}
    for topic in TOPICS:
        types[topic.direction] |= {name for name in topic.type.split(" or ") if name in MESSAGES}
    out = types["out"] | types["service"] | types["query"] | {"Imu"}  # published by the simulator
    inputs = types["in"] | {"SetPose", "Release", "SwitchOff", "Settings"}
    assert {name.removesuffix("In") for name in INCOMING} == inputs
    assert {name for name in INCOMING if name.endswith("In")} == {f"{n}In" for n in inputs & out}
    assert out | {"Config"} == set(SCHEMAS) - INCOMING


@each(
    ("name", "part", "field", "values"),
    [
        ("RobotState", "", "mode", {str(mode) for mode in Mode}),
        ("RobotState", "", "link", {state for state, _ in LINKS} | set(LINKS.values())),
        ("RobotState", "", "gyro", set(get_args(GyroDoes))),
        ("DiagnosticArray", "DiagnosticStatus", "level", {0, 1, 2, 3}),
        ("Interfaces", "HardwareInterface", "kind", {"command", "state"}),
        ("Interfaces", "HardwareInterface", "unit", {"rad", "rad/s"}),
        ("Topics", "TopicInfo", "direction", {topic.direction for topic in TOPICS}),
        ("WhoAmI", "", "role", set(get_args(Role))),
        ("Config", "LogConfig", "level", {"debug", "info", "warning", "error"}),
    ],
)  # fmt: skip
def test_a_closed_set_is_an_enum(name: str, part: str, field: str, values: set[object]) -> None:
    found = SCHEMAS[name]
    fields = (found["$defs"][part] if part else found)["properties"]
    assert set(fields[field]["enum"]) == values


@each("topic", [t for t in PUBLISHED if not t.simulated])
def test_a_published_message_is_valid_and_invalid_without_any_of_its_fields(topic: Any) -> None:
    report = Report(Config(), START)
    due(report, OUTPUTS, {topic.key}, lambda: SNAPSHOT)
    message = report.current(topic.key, lambda: SNAPSHOT) or Beat(1, 2)
    assert type(message).__name__ == topic.type
    value = as_json(message)
    assert refused(topic.type, value) == []
    assert refused(topic.type, value | {"later": 1}) == []
    for field in value:
        assert refused(topic.type, {key: entry for key, entry in value.items() if key != field})


def test_answers_are_valid_by_their_schemas() -> None:
    answers = {
        "Interfaces": interfaces(Config(), STATUS),
        "Topics": topic_table(Config()),
        "ServiceReply": ServiceReply(True, "stopped"),
        "Info": Info("acsar", "1", 7, "sim", True, 100.0, ["tcp/127.0.0.1:7448"], []),
    }
    assert {name: refused(name, as_json(value)) for name, value in answers.items()} == {
        name: [] for name in answers
    }
    for config in (
        Config(),
        Config(mcu=McuConfig(port="/dev/ttyACM0"), odometry=OdometryConfig(gyro=True)),
    ):
        value = msgspec.json.decode(msgspec.json.encode(effective(config)))
        assert refused("Config", value) == []
        assert refused("Config", value | {"mcu": value["mcu"] | {"baud_rate": 300}})
        assert refused("Config", {key: entry for key, entry in value.items() if key != "limits"})


# messages that the daemon accepts

NAMES = list(Config().joint_names)
ZERO: dict[str, Any] = {"linear": {}, "angular": {}}
TURN: dict[str, Any] = {"angular_velocity": {"z": 0.5}}
WHEELS: dict[str, Any] = {"name": NAMES, "velocity": [1.0, 1, 1, 1.0]}


def is_accepted(name: str, value: object) -> bool:
    """Return whether the daemon accepts a value on the key of this type."""
    key = {"J": "wheel_cmd/app", "T": "cmd/app", "I": "imu"}.get(name[0], "set_pose")
    payload = msgspec.json.encode(value)
    arrival = Arrival(key, True, payload, "application/json", 1_000_000_000, None, "")
    try:
        if name == "Release":
            Receiver.request("clear", 1, "application/json", payload)
        elif name == "SwitchOff":
            Receiver.request("deactivate", 1, "application/json", payload)
        elif key == "set_pose":
            Receiver.request("set_pose", 1, "application/json", payload)
        elif key == "imu":
            return GyroFollower().receive(arrival, {"imu_wrong_shape": 0}, []) is not None
        else:
            Receiver(NAMES, Kinematics(Config().drive)).command(arrival)
    except DecodeError:
        return False
    return True


@each(
    ("name", "value", "good"),
    [
        ("Twist", ZERO, True),
        ("Twist", {"linear": {"x": 1, "y": 0.0}, "angular": {"z": -1.5}}, True),
        ("Twist", {"linear": {"x": 1}}, False),
        ("Twist", {"linear": {"X": 1}, "angular": {}}, False),
        ("Twist", {"linear": {"x": "1"}, "angular": {}}, False),
        ("Twist", ZERO | {"source": "app"}, False), ("TwistStampedIn", {"twist": ZERO}, True),
        ("TwistStampedIn", {"header": {"stamp": {"sec": 5}}, "twist": ZERO}, True),
        ("TwistStampedIn", {"header": {}}, False),
        ("TwistStampedIn", {"header": {"seq": 1}, "twist": ZERO}, False),
        ("TwistStampedIn", {"header": {"stamp": {"nanosec": 10**9}}, "twist": ZERO}, False),
        ("JointStateIn", WHEELS, True),
        ("JointStateIn", WHEELS | {"header": {"frame_id": "base_link"}, "effort": []}, True),
        ("JointStateIn", {"name": NAMES}, False),
        ("JointStateIn", WHEELS | {"velocities": []}, False), ("ImuIn", TURN, True),
        ("ImuIn", TURN | {"angular_velocity_covariance": [0.1] * 9}, True),
        ("ImuIn", TURN | {"angular_velocity_covariance": [0.1]}, False),
        ("ImuIn", {"header": {}}, False), ("SetPose", {"x": 1, "y": 2.0, "yaw": 0}, True),
        ("SetPose", {"x": 1, "y": 2.0}, False),
        ("SetPose", {"x": 1, "y": 2.0, "yaw": 0, "z": 0}, False),
        ("Release", {"numbers": [5]}, True), ("Release", {"numbers": None}, True),
        ("Release", {}, True), ("Release", {"numbers": [-1]}, False),
        ("Release", {"numbers": [2**53]}, False), ("Release", {"number": 5}, False),
        ("SwitchOff", {"release_port": True}, True), ("SwitchOff", {"port": True}, False),
    ],
)  # fmt: skip
def test_the_schema_accepts_a_value_exactly_if_the_daemon_accepts_it(
    name: str, value: object, good: bool
) -> None:
    assert (refused(name, value) == [], is_accepted(name, value)) == (good, good)
