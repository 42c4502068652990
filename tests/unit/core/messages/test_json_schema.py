"""Tests of the JSON Schemas with a third-party validator."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest
from jsonschema import Draft202012Validator
from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, JointsConfig, McuConfig, OdometryConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.incoming.imu import GyroFollower
from acsard.core.incoming.queries import interfaces, topic_table
from acsard.core.link.link_state import TRANSITIONS as LINKS
from acsard.core.messages.encodings import DecodeError, encode
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import PUBLISHED, TOPICS
from acsard.core.messages.report import Report
from acsard.core.messages.schema import MESSAGES, Beat, Info, Message, ServiceReply
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.modes import Mode
from acsard.core.values import GyroDoes, Role
from tests.each import each
from tests.unit.core.messages.examples import OUTPUTS, SNAPSHOT, START, STATUS, due

INCOMING = {
    "Twist", "TwistStampedIn", "JointStateIn", "ImuIn", "SetPose", "Release", "Settings",
    "GatewayState", "SpeedLimit",
}  # fmt: skip
OUTGOING = set(SCHEMAS) - INCOMING


def parts(name: str) -> list[dict[str, Any]]:
    """Return the schema and all its nested schemas that have fields."""
    schema = SCHEMAS[name]
    return [part for part in (schema, *schema["$defs"].values()) if "properties" in part]


def refused(name: str, value: object) -> list[str]:
    """Return the validator's objections to a value."""
    return [error.message for error in Draft202012Validator(SCHEMAS[name]).iter_errors(value)]


def as_json(message: Message) -> Any:
    return msgspec.json.decode(encode(message, "json"))


# the form of the schemas


@pytest.mark.slow
@each("name", SCHEMAS)
def test_each_schema_is_valid_in_its_dialect_and_has_a_unique_id(name: str) -> None:
    schema = SCHEMAS[name]
    assert schema["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    assert (schema["$id"], schema["title"]) == (f"urn:acsard:{name}.v1", name)
    Draft202012Validator.check_schema(schema)


@each("name", sorted(OUTGOING))
def test_outgoing_messages_require_all_fields_and_permit_additional_ones(name: str) -> None:
    assert parts(name)
    for part in parts(name):
        assert part["required"] == list(part["properties"])
        assert "additionalProperties" not in part


@each("name", sorted(INCOMING))
def test_incoming_messages_may_omit_defaults_but_not_add_fields(name: str) -> None:
    assert parts(name)
    for part in parts(name):
        assert part["additionalProperties"] is False
        missing = set(part["properties"]) - set(part["required"])
        assert all(field not in part["required"] for field in missing)


def test_the_incoming_and_outgoing_schemas_are_those_of_the_topic_table() -> None:
    """Each type has a schema of its name.

    An incoming type gets the suffix `In` if it is published too.
    """
    types = {topic.direction: set[str]() for topic in TOPICS}
    for topic in TOPICS:
        types[topic.direction] |= {name for name in topic.type.split(" or ") if name in MESSAGES}
    out = types["out"] | types["service"] | types["query"] | {"Imu"}  # published by the simulator
    inputs = types["in"] | {"SetPose", "Release", "Settings"}
    assert {name.removesuffix("In") for name in INCOMING} == inputs
    assert {name for name in INCOMING if name.endswith("In")} == {f"{n}In" for n in inputs & out}
    assert out | {"Config"} == OUTGOING


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
def test_a_closed_set_of_values_is_an_enum(
    name: str, part: str, field: str, values: set[object]
) -> None:
    schema = SCHEMAS[name]
    fields = (schema["$defs"][part] if part else schema)["properties"]
    assert set(fields[field]["enum"]) == values


def test_patterns_are_ecmascript_regular_expressions() -> None:
    assert SCHEMAS["Config"]["$defs"]["RobotConfig"]["properties"]["id"]["pattern"].endswith("}$")
    assert "\\\\Z" not in msgspec.json.encode(SCHEMAS["Config"]).decode()


# messages that the daemon publishes


@each("topic", [t for t in PUBLISHED if not t.simulated])
def test_a_published_message_is_valid_and_invalid_without_any_of_its_fields(topic: Any) -> None:
    report = Report(Config(), START)
    list(due(report, OUTPUTS, {topic.key}, lambda: SNAPSHOT))
    message = report.current(topic.key, lambda: SNAPSHOT) or Beat(1, 2)
    assert type(message).__name__ == topic.type
    value = as_json(message)
    assert refused(topic.type, value) == []
    assert refused(topic.type, value | {"later": 1}) == []
    for field in value:
        assert refused(topic.type, {key: entry for key, entry in value.items() if key != field})


@each("mode", [*Mode])
def test_the_schema_of_the_state_accepts_each_mode_and_no_other(mode: str) -> None:
    report = Report(Config(), START)
    list(due(report, replace(OUTPUTS, mode=mode), {"state"}, lambda: SNAPSHOT))
    message = report.current("state", lambda: SNAPSHOT)
    assert message is not None
    state = as_json(message)
    assert refused("RobotState", state) == []
    assert refused("RobotState", state | {"mode": "idle"})


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


@pytest.mark.parametrize(
    "config",
    [Config(), Config(mcu=McuConfig(port="/dev/ttyACM0"), odometry=OdometryConfig(gyro=True))],
)
def test_the_effective_configuration_is_valid_by_its_schema(config: Config) -> None:
    value = msgspec.json.decode(msgspec.json.encode(effective(config)))
    assert refused("Config", value) == []
    assert refused("Config", value | {"mcu": value["mcu"] | {"baud_rate": 300}})
    assert refused("Config", {key: entry for key, entry in value.items() if key != "limits"})


# messages that the daemon accepts

NAMES = list(JointsConfig().as_tuple())
ZERO: dict[str, Any] = {"linear": {}, "angular": {}}
TURN: dict[str, Any] = {"angular_velocity": {"z": 0.5}}
WHEELS: dict[str, Any] = {"name": NAMES, "velocity": [1.0, 1, 1, 1.0]}


def is_accepted(name: str, value: object) -> bool:
    """Return whether the daemon accepts a value on the key of this type."""
    key = {"J": "wheel_cmd/app", "T": "cmd/app", "I": "imu"}.get(name[0], "set_pose")
    payload = msgspec.json.encode(value)
    if name == "Release":
        return _decodes(lambda: Receiver.request("clear", 1, "application/json", payload))
    if key == "set_pose":
        return _decodes(lambda: Receiver.request("set_pose", 1, "application/json", payload))
    arrival = Arrival(key, True, payload, "application/json", 1_000_000_000, None, "")
    if key == "imu":
        return GyroFollower().receive(arrival, {"imu_wrong_shape": 0}, []) is not None
    receiver = Receiver(JointsConfig(), Kinematics(Config().drive))
    return _decodes(lambda: receiver.command(arrival))


def _decodes(call: Any) -> bool:
    try:
        call()
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
        ("Twist", ZERO | {"source": "app"}, False),
        ("TwistStampedIn", {"twist": ZERO}, True),
        ("TwistStampedIn", {"header": {"stamp": {"sec": 5}}, "twist": ZERO}, True),
        ("TwistStampedIn", {"header": {}}, False),
        ("TwistStampedIn", {"header": {"seq": 1}, "twist": ZERO}, False),
        ("TwistStampedIn", {"header": {"stamp": {"nanosec": 10**9}}, "twist": ZERO}, False),
        ("JointStateIn", WHEELS, True),
        ("JointStateIn", WHEELS | {"header": {"frame_id": "base_link"}, "effort": []}, True),
        ("JointStateIn", {"name": NAMES}, False),
        ("JointStateIn", WHEELS | {"velocities": []}, False),
        ("ImuIn", TURN, True),
        ("ImuIn", TURN | {"angular_velocity_covariance": [0.1] * 9}, True),
        ("ImuIn", TURN | {"angular_velocity_covariance": [0.1]}, False),
        ("ImuIn", {"header": {}}, False),
        ("SetPose", {"x": 1, "y": 2.0, "yaw": 0}, True),
        ("SetPose", {"x": 1, "y": 2.0}, False),
        ("SetPose", {"x": 1, "y": 2.0, "yaw": 0, "z": 0}, False),
        ("Release", {"numbers": [5]}, True),
        ("Release", {"numbers": None}, True),
        ("Release", {}, True),
        ("Release", {"numbers": [-1]}, False),
        ("Release", {"numbers": [2**53]}, False),
        ("Release", {"number": 5}, False),
    ],
)  # fmt: skip
def test_the_schema_accepts_a_value_exactly_if_the_daemon_accepts_it(
    name: str, value: object, good: bool
) -> None:
    assert (refused(name, value) == [], is_accepted(name, value)) == (good, good)
