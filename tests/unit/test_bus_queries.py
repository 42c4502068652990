"""Each key that can be queried gives the designed answer; a service needs its exact key."""

from __future__ import annotations

import math
from typing import Any, cast

import msgspec
import pytest
from msgspec.structs import replace

from acsard.core.config.parsing import effective, from_builtins
from acsard.core.config.settings import (
    Config,
    JointsConfig,
    LidarConfig,
    LimitsConfig,
    OdometryConfig,
    RobotConfig,
)
from acsard.core.incoming.queries import (
    Queries,
    Query,
    Reply,
    offered_services,
    topic_table,
)
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import BEAT, PUBLISHED, SERVICES, TOPICS
from acsard.core.messages.keys_and_roles import offered as offered_topics
from acsard.core.messages.report import Report
from acsard.core.messages.schema import Info, Interfaces, Message, ServiceReply, Topics
from acsard.core.messages.signature import public_name
from acsard.core.ros.shapes import Trigger
from acsard.core.values import ROLES, Answer, Pose, Request, Status
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, STATUS, due

CONFIG = Config(robot=RobotConfig("r7"))
NOW = OUTPUTS.now.wall_ns, STATUS
WALL_NS = 1_700_000_000_000_000_000
INFO = Info("r7", "1.2.3", 42, "/dev/pts/3", True, 100.0, ["tcp/127.0.0.1:7448"], [])
DONE = Answer(7, True, "done")


def queries(config: Config = CONFIG) -> Queries:
    return Queries(config, INFO)


def nothing(_: str) -> Message | None:
    return None


REPORT = Report(CONFIG, START)
due(REPORT, OUTPUTS, set(), lambda: SNAPSHOT)


def last(key: str) -> Message | None:
    return REPORT.current(key, lambda: SNAPSHOT)


def query(topic: str, asked: str | None = None, fmt: str = "", **changes: Any) -> Query:
    fields: dict[str, Any] = {"ticket": 7, "payload": b"", "encoding": ""} | changes
    return Query(topic=topic, asked=topic if asked is None else asked, fmt=fmt, **fields)


def answers(asked: Query, made: Queries | None = None) -> list[Reply]:
    replies = (made or queries()).serve(asked, last, *NOW)
    assert isinstance(replies, list)
    return replies


def answer(asked: Query) -> Reply:
    (reply,) = answers(asked)
    return reply


def served(asked: Query, made: Queries | None = None) -> Request | list[Reply]:
    return (made or queries()).serve(asked, nothing, *NOW)


# readable keys


@each("topic", [t for t in PUBLISHED if not t.simulated and t.key != BEAT])
@each("form", FORMATS)
def test_a_key_answers_with_its_last_value_in_the_asked_format(topic: Any, form: Format) -> None:
    value = last(topic.key)
    reply = answer(query(topic.key, fmt=form))
    try:
        payload = encode(value, form)
    except DecodeError:
        text = f"{topic.type} is not a ROS message and has no CDR form: use JSON"
        assert reply == Reply(7, topic.key, text.encode(), "text/plain", ok=False)
        return
    assert reply == Reply(7, topic.key, payload, encoding_name(form, topic.type))
    assert served(query(topic.key, fmt=form)) == []  # no value yet
    # Without a format it is JSON. The JSON tree and a wildcard have the same answer.
    plain = answer(query(topic.key))
    assert plain.payload == encode(value, "json")
    assert answer(query(f"json/{topic.key}")) == replace(plain, key=f"json/{topic.key}")
    assert answer(query(topic.key, "acsard/*/odom")) == plain


@each("form", ["msgpack", "json"])
def test_info_and_config_are_those_in_force(form: Format) -> None:
    info = Reply(7, "info", encode(INFO, form), encoding_name(form, "Info"))
    assert answer(query("info", fmt=form)) == info
    made = queries()
    codec = msgspec.json if form == "json" else msgspec.msgpack
    for config in (CONFIG, replace(CONFIG, limits=LimitsConfig(linear_speed=0.7))):
        made.config = config
        (reply,) = answers(query("config", fmt=form), made)
        value = codec.decode(reply.payload)
        assert from_builtins(value) == config
        assert value == msgspec.json.decode(msgspec.json.encode(effective(config)))
        assert reply.encoding == encoding_name(form)


@pytest.mark.parametrize("role", ROLES)
def test_whoami_returns_the_role_in_the_key_and_the_name_of_the_caller(role: str) -> None:
    sender = msgspec.msgpack.encode({"sender": "joe@laptop/s3cret"})
    reply = answer(query("whoami/<role>", f"whoami/{role}", attachment=sender))
    assert reply.key == f"whoami/{role}"
    name = f"{public_name('joe@laptop/s3cret')} (native)"
    assert msgspec.json.decode(reply.payload) == {"role": role, "sender": name}


def test_topics_returns_the_whole_table_with_full_keys() -> None:
    reply = answer(query("topics"))
    table = msgspec.json.decode(reply.payload, type=Topics).topics
    assert [(row.key, row.direction, row.type, row.note) for row in table] == [
        (f"acsard/r7/{topic.key}", topic.direction, topic.type, topic.note)
        for topic in offered_topics(CONFIG)
    ]
    assert reply.encoding == encoding_name("json", "Topics")


def test_the_table_has_only_the_topics_that_the_daemon_publishes() -> None:
    def keys(**tables: Any) -> set[str]:
        return {
            row.key.removeprefix("acsard/acsar/") for row in topic_table(Config(**tables)).topics
        }

    assert keys() - keys(lidar=LidarConfig(publish_tf=False)) == {"tf_static"}
    assert keys() - keys(odometry=OdometryConfig(publish_tf=False)) == {"tf"}
    assert keys(odometry=OdometryConfig(gyro=True)) - keys() == {"imu"}


@each("name", SCHEMAS)
def test_each_type_has_a_schema(name: str) -> None:
    reply = answer(query("schema/<Type>", f"schema/{name}"))
    assert (reply.key, reply.encoding) == (f"schema/{name}", "application/json")
    assert msgspec.json.decode(reply.payload) == SCHEMAS[name]


@each("asked", ["schema/*", "**", "acsard/*/schema/*", "schema/Odo$*", "**/" + "$*a" * 10_000])
def test_a_wildcard_gets_all_schemas_of_which_zenoh_sends_those_that_it_includes(
    asked: str,
) -> None:
    replies = answers(query("schema/<Type>", asked))
    assert [reply.key for reply in replies] == [f"schema/{name}" for name in SCHEMAS]


@each("asked", ["schema/", "schema/Nothing", "schema/odometry", "schema/Odometry/x"])
def test_an_unknown_type_has_no_schema(asked: str) -> None:
    assert answers(query("schema/<Type>", asked)) == []


@each(
    ("topic", "asked"),
    [("nonsense", "nonsense"),
     *(("whoami/<role>", asked) for asked in ("whoami/*", "whoami/**", "**", "whoami/admin"))],
)  # fmt: skip
def test_an_unknown_key_or_role_or_a_wildcard_role_has_no_answer(topic: str, asked: str) -> None:
    assert answers(query(topic, asked)) == []


@each("key", [t.key for t in TOPICS if t.direction != "in" and t.key != "alive"])
@each("fmt", ["xml", "JSON", "CDR", " json"])
def test_an_unknown_format_is_answered_with_an_error_text(key: str, fmt: str) -> None:
    reply = answer(query(key, fmt=fmt))
    text = reply.payload.decode()
    assert (reply.ok, reply.ticket, reply.encoding) == (False, 7, "text/plain")
    assert text.startswith(f"fmt={fmt}: ")
    assert all(f"fmt={form}" in text for form in FORMATS)


def test_the_base_has_four_command_and_eight_state_interfaces() -> None:
    joints = ("a", "b", "c", "d")

    def interfaces(status: Status) -> list[Any]:
        (reply,) = cast(list[Reply], queries(Config(joints=JointsConfig(*joints))).serve(
            query("interfaces"), nothing, 0, status))  # fmt: skip
        assert reply.encoding == encoding_name("json", "Interfaces")
        return msgspec.json.decode(reply.payload, type=Interfaces).interfaces

    rows = interfaces(STATUS)
    assert [(row.name, row.kind, row.unit) for row in rows] == [
        *((f"{j}/velocity", "command", "rad/s") for j in joints),
        *((f"{j}/{name}", "state", unit) for j in joints
          for name, unit in (("position", "rad"), ("velocity", "rad/s"))),
    ]  # fmt: skip
    # They are available while the link is up, and commands are claimed while the robot drives.
    assert [row.available for row in rows] == [True] * 12
    assert [row.claimed for row in rows] == [True] * 4 + [False] * 8
    assert not any(row.available for row in interfaces(replace(STATUS, link="stale")))
    assert not any(row.claimed for row in interfaces(replace(STATUS, mode="ready")))


# services

POSE = encode({"x": 1.0, "y": 2.0, "yaw": 3.0}, "json")
SETTINGS = encode({"settings": {"limits.linear_speed": 0.8, "log.level": "debug"}}, "json")
PAYLOADS = {"set_pose": POSE, "set": SETTINGS, "clear": encode({"numbers": [5]}, "json")}
ASKED: dict[str, dict[str, Any]] = {
    "set_pose": {"pose": Pose(1.0, 2.0, 3.0)}, "clear": {"numbers": (5,)},
    "set": {"settings": {"limits.linear_speed": 0.8, "log.level": "debug"}},
}  # fmt: skip
WILDCARDS = ["**", "*", "srv/*", "srv/**", "*/stop", "srv/st$*", "acsard/*/srv/stop", "acsard/**"]
SIMILAR = ["srv/stop/", "srv", "/srv/stop", "srv/other", "SRV/STOP", ""]


@each("verb", SERVICES)
def test_a_service_runs_for_its_exact_key_only(verb: Any) -> None:
    payload = PAYLOADS.get(verb, b"")
    expected = Request(verb, 7, by="unnamed (native)", **ASKED.get(verb, {}))
    made = queries()
    for asked in (*WILDCARDS, *SIMILAR):
        assert served(query(f"srv/{verb}", asked, payload=payload), made) == []
    assert made.answered(DONE, WALL_NS) is None
    assert served(query(f"srv/{verb}", payload=payload), made) == expected
    reply = made.answered(DONE, WALL_NS)
    assert reply is not None
    assert reply.key == f"srv/{verb}"
    assert made.answered(DONE, WALL_NS) is None  # an answer goes back only once
    if not SERVICES[verb].payload:
        assert isinstance(served(query(f"srv/{verb}", payload=b"\xff nonsense")), Request)


@each(
    ("verb", "words"),
    [
        ("explode", "'explode' is not a service of this robot; its services are stop, clear, "),
        ("stopp", "'stopp' is not a service of this robot; did you mean stop?"),
        ("x" * 999, f"'{'x' * 40}' is not a service of this robot; its services are "),
    ],
)
def test_a_service_that_the_daemon_lacks_is_refused_in_words(verb: str, words: str) -> None:
    reply = answer(query(f"srv/{verb}", payload=b"{}"))
    result = msgspec.json.decode(reply.payload, type=ServiceReply)
    assert (reply.key, reply.ok, result.success) == (f"srv/{verb}", True, False)
    assert result.message.startswith(words)


def test_info_offers_each_service_with_the_fields_of_its_payload() -> None:
    services = offered_services()
    assert set(services) == set(SERVICES)
    fields = [services[verb] for verb in ("stop", "clear", "set_pose")]
    assert fields == [[], ["numbers"], ["x", "y", "yaw"]]


def test_the_answer_of_the_robot_goes_back_to_the_caller() -> None:
    made = queries()
    for ticket, verb in ((12, "clear"), (13, "stop")):
        served(query(f"srv/{verb}", ticket=ticket), made)
    for success, ticket, key in ((False, 13, "srv/stop"), (True, 12, "srv/clear")):
        reply = made.answered(Answer(ticket, success, "because"), WALL_NS)
        payload = encode(ServiceReply(success, "because"), "json")
        assert reply == Reply(ticket, key, payload, encoding_name("json", "ServiceReply"))
    assert made.answered(Answer(0, True, "stopped"), WALL_NS) is None


MSGPACK = encode({"x": 1, "y": 2, "yaw": 3}, "msgpack")
EMPTY = b"\x00\x01\x00\x00\x00"


@each(
    ("fmt", "payload", "form"),
    [
        ("", b"", "json"), ("", POSE, "json"), ("", MSGPACK, "msgpack"), ("json", MSGPACK, "json"),
        ("msgpack", POSE, "msgpack"), ("cdr", b"", "cdr"), ("cdr", POSE, "cdr"), ("", EMPTY, "cdr"),
        ("", EMPTY[:4], "cdr"), ("", b"\x00\x00\x00\x03\x00\x00\x00\x00", "cdr"),
        ("json", EMPTY, "json"),
    ],
)  # fmt: skip
def test_a_service_answers_in_the_requested_format_or_else_in_that_of_the_payload(
    fmt: str, payload: bytes, form: Format
) -> None:
    made = queries()
    assert isinstance(served(query("srv/reset_odometry", fmt=fmt, payload=payload), made), Request)
    reply = made.answered(Answer(7, True, "ok"), WALL_NS)
    assert reply is not None
    message = Trigger(True, "ok") if form == "cdr" else ServiceReply(True, "ok")
    assert reply.payload == encode(message, form)
    assert reply.encoding == encoding_name(form, "ServiceReply")
    # as a ROS Trigger
    assert form != "cdr" or reply.payload == bytes.fromhex("00010000 01000000 03000000 6f6b00")


@each(
    ("verb", "payload", "words"),
    [
        *(("set_pose", payload, words) for payload, words in (
            (b"", "not a JSON object, a msgpack map or CDR"),
            (b"{", "Input data was truncated"), (b"{}", "missing required field `x`"),
            (b'{"x": 1, "y": 2, "yaw": "3"}', "Expected `float`"),
            (b'{"x": 1, "y": 2, "yaw": 3, "z": 4}', "unknown field `z`"),
            (b'{"x": 1e7, "y": 2, "yaw": 3}', "x and y must be within 1000 km"),
            (encode({"x": 1.0, "y": 2.0, "yaw": math.nan}, "msgpack"), "yaw must be finite"))),
        *(("set", f'{{"settings": {{"rates.odom": {value}}}}}'.encode(), "$.settings")
          for value in (-(1 << 63) - 1, 1 << 63, 10**20, 10**300)),
    ],
)  # fmt: skip
def test_an_invalid_payload_is_answered_with_a_text_and_makes_no_request_to_the_robot(
    verb: str, payload: bytes, words: str
) -> None:
    made = queries()
    (reply,) = answers(query(f"srv/{verb}", payload=payload, fmt="json"), made)
    assert (reply.ok, reply.ticket, reply.key) == (True, 7, f"srv/{verb}")
    result = msgspec.json.decode(reply.payload, type=ServiceReply)
    assert not result.success
    assert words in result.message
    assert verb == "set" or result.message.endswith('; send {"x": 0, "y": 0, "yaw": 0}')
    assert made.answered(DONE, WALL_NS) is None
