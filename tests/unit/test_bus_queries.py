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
    most_bytes,
    offered_services,
    refused,
    topic_table,
)
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import (
    BEAT,
    PLAIN_SERVICES,
    PUBLISHED,
    SERVICES,
    TOPICS,
    offered,
)
from acsard.core.messages.refusals import BUSY, BUSY_ENCODING
from acsard.core.messages.report import Report
from acsard.core.messages.schema import MESSAGES, Info, Interfaces, Message, ServiceReply, Topics
from acsard.core.messages.signature import public_name
from acsard.core.ros import parameters as rcl
from acsard.core.ros.attachments import Attachment, unpack
from acsard.core.ros.shapes import Trigger
from acsard.core.ros.transports import PARAMETER_SERVICES
from acsard.core.values import ROLES, Answer, Plain, Pose, Request, Status
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, STATUS, due

NATIVE = ("odom", "tf", "tf_static", "wheel_states", "cmd_vel_out", "diagnostics")
"""Published keys whose types are ROS messages and therefore have a CDR form."""

CONFIG = Config(robot=RobotConfig("r7"))
NOW = OUTPUTS.now.wall_ns, STATUS
WALL_NS = 1_700_000_000_000_000_000
NO = rcl.SetParametersResult(
    False, "the payload must begin with the header of plain CDR, not with 00"
)
INFO = Info("r7", "1.2.3", 42, "/dev/pts/3", True, 100.0, ["tcp/127.0.0.1:7448"], [])

WILDCARDS = ["**", "*", "srv/*", "srv/**", "*/stop", "srv/st$*", "acsard/*/srv/stop", "acsard/**"]
"""Key expressions with which a client may query more than one key.

The prefix is removed only from those that contain it.
"""


def queries(config: Config = CONFIG) -> Queries:
    return Queries(config, INFO)


def report() -> Report:
    made = Report(CONFIG, START)
    due(made, OUTPUTS, set(), lambda: SNAPSHOT)
    return made


def nothing(_: str) -> Message | None:
    return None


def query(topic: str, asked: str | None = None, fmt: str = "", **changes: Any) -> Query:
    fields: dict[str, Any] = {"ticket": 7, "payload": b"", "encoding": ""} | changes
    return Query(topic=topic, asked=topic if asked is None else asked, fmt=fmt, **fields)


def answers(asked: Query) -> list[Reply]:
    made = report()
    replies = queries().serve(asked, lambda key: made.current(key, lambda: SNAPSHOT), *NOW)
    assert isinstance(replies, list)
    return replies


def answer(asked: Query) -> Reply:
    (reply,) = answers(asked)
    return reply


# readable keys


@each("topic", [t for t in PUBLISHED if not t.simulated and t.key != BEAT])
@each("form", ["msgpack", "json"])
def test_a_published_key_answers_with_its_last_value(topic: Any, form: Format) -> None:
    reply = answer(query(topic.key, fmt=form))
    assert reply == Reply(
        7,
        topic.key,
        encode(report().current(topic.key, lambda: SNAPSHOT), form),
        encoding_name(form, topic.type),
    )


@pytest.mark.parametrize("key", ["odom", "state"])
def test_a_key_of_the_json_tree_has_the_answer_of_the_plain_key(key: str) -> None:
    plain = answer(query(key))
    assert answer(query(f"json/{key}")) == replace(plain, key=f"json/{key}")


@each("topic", [t for t in PUBLISHED if t.key in NATIVE])
def test_a_ros_message_is_also_answered_as_cdr(topic: Any) -> None:
    reply = answer(query(topic.key, fmt="cdr"))
    assert (reply.ticket, reply.key, reply.ok) == (7, topic.key, True)
    assert reply.encoding == f"application/cdr;acsard.{topic.type}.v1"
    assert reply.payload[:4] == b"\x00\x01\x00\x00"
    message = Cdr(MESSAGES[topic.type]).decode(reply.payload)
    assert message == report().current(topic.key, lambda: SNAPSHOT)


@each(
    ("topic", "asked", "kind"),
    [
        ("state", "state", "RobotState"),
        ("state", "**", "RobotState"),
        ("info", "info", "Info"),
        ("config", "config", "dict"),
        ("schema/<Type>", "schema/Odometry", "dict"),
    ],
)
def test_a_query_for_cdr_of_a_type_that_is_not_a_ros_message_is_refused_with_a_text(
    topic: str, asked: str, kind: str
) -> None:
    assert answer(query(topic, asked, fmt="cdr")) == Reply(
        7,
        topic,
        f"{kind} is not a ROS message and has no CDR form: use JSON".encode(),
        "text/plain",
        ok=False,
    )


@each("topic", PUBLISHED)
@each("fmt", ["", "cdr"])
def test_a_published_key_without_a_value_yet_has_no_answer(topic: Any, fmt: str) -> None:
    assert queries().serve(query(topic.key, fmt=fmt), nothing, *NOW) == []


@each("asked", ["odom", "**", "*", "acsard/*/odom"])
def test_a_wildcard_query_gets_the_last_value_under_its_exact_key(asked: str) -> None:
    assert answer(query("odom", asked)).key == "odom"


@pytest.mark.parametrize("form", ["msgpack", "json"])
def test_info_identifies_the_daemon(form: Format) -> None:
    assert answer(query("info", fmt=form)) == Reply(
        7, "info", encode(INFO, form), encoding_name(form, "Info")
    )


@pytest.mark.parametrize("form", ["msgpack", "json"])
def test_config_is_the_configuration_in_force(form: Format) -> None:
    reply = answer(query("config", fmt=form))
    codec = msgspec.json if form == "json" else msgspec.msgpack
    assert from_builtins(codec.decode(reply.payload)) == CONFIG
    assert codec.decode(reply.payload) == msgspec.json.decode(
        msgspec.json.encode(effective(CONFIG))
    )
    assert reply.encoding == encoding_name(form)


@pytest.mark.parametrize("role", ROLES)
def test_whoami_returns_the_role_in_the_key_and_the_name_of_the_caller(role: str) -> None:
    sender = msgspec.msgpack.encode({"sender": "joe@laptop/s3cret"})
    asked = f"whoami/{role}"
    reply = answer(query("whoami/<role>", asked, attachment=sender))
    assert reply.key == asked
    assert msgspec.json.decode(reply.payload) == {
        "role": role,
        "sender": f"{public_name('joe@laptop/s3cret')} (native)",
    }


@each("asked", ["whoami/*", "whoami/**", "**", "whoami/admin"])
def test_whoami_does_not_answer_a_wildcard_or_an_unknown_role(asked: str) -> None:
    assert answers(query("whoami/<role>", asked)) == []


def test_topics_returns_the_whole_table_with_full_keys() -> None:
    reply = answer(query("topics"))
    table = msgspec.json.decode(reply.payload, type=Topics).topics
    assert [row.key for row in table] == [f"acsard/r7/{topic.key}" for topic in offered(CONFIG)]
    assert [(row.direction, row.type, row.note) for row in table] == [
        (topic.direction, topic.type, topic.note) for topic in offered(CONFIG)
    ]
    assert reply.encoding == encoding_name("json", "Topics")


@each("lidar", [True, False])
def test_the_table_has_only_the_transforms_that_the_daemon_publishes(lidar: bool) -> None:
    keys = {row.key for row in topic_table(Config(lidar=LidarConfig(publish_tf=lidar))).topics}
    assert ("acsard/acsar/tf_static" in keys) == lidar
    assert "acsard/acsar/tf" in keys
    silent = topic_table(Config(odometry=OdometryConfig(publish_tf=False)))
    assert "acsard/acsar/tf" not in {row.key for row in silent.topics}
    simulated = topic_table(Config(odometry=OdometryConfig(gyro=True)))
    assert "acsard/acsar/imu" in {row.key for row in simulated.topics}


@each("name", SCHEMAS)
def test_each_type_has_a_schema(name: str) -> None:
    reply = answer(query("schema/<Type>", f"schema/{name}"))
    assert reply.key == f"schema/{name}"
    assert msgspec.json.decode(reply.payload) == SCHEMAS[name]
    assert reply.encoding == "application/json"


@each("asked", ["schema/*", "schema/**", "**", "acsard/*/schema/*"])
def test_a_wildcard_for_all_types_gives_every_schema(asked: str) -> None:
    assert [reply.key for reply in answers(query("schema/<Type>", asked))] == [
        f"schema/{name}" for name in SCHEMAS
    ]


@each(
    ("asked", "types"),
    [
        ("schema/Odo$*", [name for name in SCHEMAS if name.startswith("Odo")]),
        ("schema/Twist$*", [name for name in SCHEMAS if name.startswith("Twist")]),
        ("schema/$*met$*", [name for name in SCHEMAS if "met" in name[1:-1]]),
        ("schema/O$*m$*t$*y", ["Odometry"]),
        ("schema/Odometry$*y", []),
        ("schema/*/Odometry", []),
        ("schema/Odometry/**", ["Odometry"]),
        ("*/Odometry", ["Odometry"]),
        ("**/Odometry", ["Odometry"]),
        ("acsard/*/schema/Odometry", ["Odometry"]),
        ("acsard/*/state/*", []),
        ("**/" + "$*a" * 10_000, []),
    ],
)
def test_a_wildcard_gives_the_schemas_whose_keys_it_includes(asked: str, types: list[str]) -> None:
    assert [reply.key for reply in answers(query("schema/<Type>", asked))] == [
        f"schema/{name}" for name in types
    ]


@each("name", ["", "Nothing", "odometry", "Odometry/x", "<Type>"])
def test_an_unknown_type_has_no_schema(name: str) -> None:
    assert answers(query("schema/<Type>", f"schema/{name}")) == []


def test_a_key_that_is_not_in_the_table_has_no_answer() -> None:
    assert answers(query("nonsense")) == []


@each("key", [t.key for t in TOPICS if t.direction != "in" and t.key != "alive"])
@each("fmt", ["xml", "JSON", "CDR", " json"])
def test_an_unknown_format_is_answered_with_an_error_text(key: str, fmt: str) -> None:
    reply = answer(query(key, fmt=fmt))
    assert not reply.ok
    assert reply.ticket == 7
    assert reply.payload.decode().startswith(f"fmt={fmt}: ")
    assert reply.encoding == "text/plain"


@pytest.mark.parametrize("form", FORMATS)
def test_the_error_for_an_unknown_format_lists_the_known_formats(form: Format) -> None:
    assert f"fmt={form}" in answer(query("odom", fmt="xml")).payload.decode()


@each("key", ["odom", "info", "config", "topics", "interfaces"])
def test_without_a_format_the_answer_is_json(key: str) -> None:
    reply = answer(query(key))
    assert reply.ok
    assert reply.encoding.startswith("application/json")
    assert reply.payload.startswith(b"{")


# interfaces


def interfaces(config: Config, status: Status) -> list[dict[str, Any]]:
    replies = queries(config).serve(query("interfaces"), nothing, 0, status)
    assert isinstance(replies, list)
    assert replies[0].encoding == encoding_name("json", "Interfaces")
    return [
        msgspec.to_builtins(interface)
        for interface in msgspec.json.decode(replies[0].payload, type=Interfaces).interfaces
    ]


def test_the_base_has_four_command_and_eight_state_interfaces() -> None:
    joints = ("a", "b", "c", "d")
    rows = interfaces(Config(joints=JointsConfig(*joints)), STATUS)
    assert [(row["name"], row["kind"], row["unit"]) for row in rows] == [
        *((f"{j}/velocity", "command", "rad/s") for j in joints),
        *(
            (f"{j}/{name}", "state", unit)
            for j in joints
            for name, unit in (("position", "rad"), ("velocity", "rad/s"))
        ),
    ]


def test_the_interfaces_are_available_while_the_link_is_up() -> None:
    assert all(row["available"] for row in interfaces(CONFIG, STATUS))
    assert not any(row["available"] for row in interfaces(CONFIG, replace(STATUS, link="stale")))


def test_only_command_interfaces_are_claimed_and_only_while_driving() -> None:
    claimed = [row["name"] for row in interfaces(CONFIG, STATUS) if row["claimed"]]
    assert claimed == [f"{joint}/velocity" for joint in CONFIG.joints.as_tuple()]
    assert not any(row["claimed"] for row in interfaces(CONFIG, replace(STATUS, mode="ready")))


# services

POSE = encode({"x": 1.0, "y": 2.0, "yaw": 3.0}, "json")
CLEAR = encode({"numbers": [5]}, "json")
SETTINGS = encode({"settings": {"limits.linear_speed": 0.8, "log.level": "debug"}}, "json")


def payload_for(verb: str) -> bytes:
    return {"set_pose": POSE, "set": SETTINGS, "clear": CLEAR}.get(verb, b"")


@each("verb", SERVICES)
def test_a_service_query_with_its_exact_key_makes_a_request_to_the_robot(verb: Any) -> None:
    request = queries().serve(query(f"srv/{verb}", payload=payload_for(verb)), nothing, *NOW)
    pose = Pose(1.0, 2.0, 3.0) if verb == "set_pose" else None
    values: dict[str, Plain] = {"limits.linear_speed": 0.8, "log.level": "debug"}
    settings = values if verb == "set" else {}
    numbers = (5,) if verb == "clear" else None
    by = "unnamed (native)"
    assert request == Request(verb, 7, pose, by=by, settings=settings, numbers=numbers)


@each("value", [-(1 << 63) - 1, 1 << 63, 10**20, 10**300])
def test_a_setting_with_an_integer_above_64_bits_is_refused(value: int) -> None:
    asked = query("srv/set", payload=f'{{"settings": {{"rates.odom": {value}}}}}'.encode())
    replies = queries().serve(asked, nothing, *NOW)
    assert isinstance(replies, list)
    assert "$.settings" in str(replies[0])


@each("asked", WILDCARDS)
@each("verb", SERVICES)
def test_a_wildcard_never_runs_a_service(verb: str, asked: str) -> None:
    made = queries()
    assert made.serve(query(f"srv/{verb}", asked, payload=payload_for(verb)), nothing, *NOW) == []
    assert made.answered(Answer(7, True, "done"), WALL_NS) is None


@each("asked", ["srv/stop/", "srv", "/srv/stop", "srv/clear", "SRV/STOP", ""])
def test_a_service_does_not_run_for_a_key_that_only_resembles_its_own(asked: str) -> None:
    assert queries().serve(query("srv/stop", asked), nothing, *NOW) == []


@each(
    ("verb", "words"),
    [
        ("explode", "'explode' is not a service of this robot; its services are stop, clear, "),
        ("stopp", "'stopp' is not a service of this robot; did you mean stop?"),
        ("x" * 999, f"'{'x' * 40}' is not a service of this robot; its services are "),
    ],
)
def test_a_service_that_this_daemon_does_not_have_is_refused_in_words(
    verb: str, words: str
) -> None:
    made = queries()
    (reply,) = cast(list[Reply], made.serve(query(f"srv/{verb}", payload=b"{}"), nothing, *NOW))
    answer = msgspec.json.decode(reply.payload, type=ServiceReply)
    assert (reply.key, reply.ok, answer.success) == (f"srv/{verb}", True, False)
    assert answer.message.startswith(words)
    assert made.answered(Answer(7, True, "done"), WALL_NS) is None


def test_info_offers_each_service_with_the_fields_of_its_payload() -> None:
    services = offered_services()
    assert set(services) == set(SERVICES)
    assert services["stop"] == []
    assert services["clear"] == ["numbers"]
    assert services["set_pose"] == ["x", "y", "yaw"]


@pytest.mark.parametrize("success", [True, False])
def test_the_answer_of_the_robot_goes_back_to_the_caller(success: bool) -> None:
    made = queries()
    made.serve(query("srv/clear", ticket=12), nothing, *NOW)
    made.serve(query("srv/stop", ticket=13), nothing, *NOW)
    reply = made.answered(Answer(13, success, "because"), WALL_NS)
    assert reply == Reply(
        13,
        "srv/stop",
        encode(ServiceReply(success, "because"), "json"),
        encoding_name("json", "ServiceReply"),
    )


def test_an_answer_goes_back_only_once() -> None:
    made = queries()
    made.serve(query("srv/stop"), nothing, *NOW)
    assert made.answered(Answer(7, True, ""), WALL_NS) is not None
    assert made.answered(Answer(7, True, ""), WALL_NS) is None


def test_an_answer_without_a_waiting_caller_makes_no_reply() -> None:
    assert queries().answered(Answer(0, True, "stopped"), WALL_NS) is None


@each(
    ("fmt", "payload", "encoding", "form"),
    [
        ("", b"", "", "json"),
        ("", POSE, "", "json"),
        ("", encode({"x": 1, "y": 2, "yaw": 3}, "msgpack"), "", "msgpack"),
        ("", encode({"x": 1, "y": 2, "yaw": 3}, "msgpack"), "application/msgpack", "msgpack"),
        ("json", encode({"x": 1, "y": 2, "yaw": 3}, "msgpack"), "", "json"),
        ("msgpack", POSE, "", "msgpack"),
        ("cdr", b"", "", "cdr"),
        ("cdr", POSE, "", "cdr"),
        ("", b"\x00\x01\x00\x00\x00", "", "cdr"),
        ("", b"\x00\x01\x00\x00", "", "cdr"),
        ("", b"\x00\x00\x00\x03\x00\x00\x00\x00", "", "cdr"),
        ("json", b"\x00\x01\x00\x00\x00", "", "json"),
    ],
)
def test_a_service_answers_in_the_requested_format_or_else_in_that_of_the_payload(
    fmt: str, payload: bytes, encoding: str, form: Format
) -> None:
    made = queries()
    asked = query("srv/reset_odometry", fmt=fmt, payload=payload, encoding=encoding)
    assert isinstance(made.serve(asked, nothing, *NOW), Request)
    reply = made.answered(Answer(7, True, "done"), WALL_NS)
    assert reply is not None
    message = Trigger(True, "done") if form == "cdr" else ServiceReply(True, "done")
    assert reply.payload == encode(message, form)
    assert reply.encoding == encoding_name(form, "ServiceReply")


def test_a_service_called_in_cdr_answers_like_a_ros_trigger() -> None:
    made = queries()
    made.serve(query("srv/stop", payload=b"\x00\x01\x00\x00\x00"), nothing, *NOW)
    reply = made.answered(Answer(7, True, "ok"), WALL_NS)
    assert reply is not None
    assert reply.payload == bytes.fromhex("00010000 01000000 03000000 6f6b00")


@pytest.mark.parametrize(
    "verb", [verb for verb, service in SERVICES.items() if not service.payload]
)
def test_a_service_without_arguments_runs_whatever_the_payload(verb: str) -> None:
    request = queries().serve(query(f"srv/{verb}", payload=b"\xff nonsense"), nothing, *NOW)
    assert isinstance(request, Request)


@each(
    ("payload", "words"),
    [
        (b"", "not a JSON object, a msgpack map or CDR"),
        (b"nonsense", "not a JSON object, a msgpack map or CDR"),
        (b"{", "Input data was truncated"),
        (b"{}", "missing required field `x`"),
        (b'{"x": 1, "y": 2}', "missing required field `yaw`"),
        (b'{"x": 1, "y": 2, "yaw": "3"}', "Expected `float`"),
        (b'{"x": 1, "y": 2, "yaw": 3, "z": 4}', "unknown field `z`"),
        (b'{"x": 1e7, "y": 2, "yaw": 3}', "x and y must be within 1000 km"),
        (encode({"x": 1.0, "y": 2.0, "yaw": math.nan}, "msgpack"), "yaw must be finite"),
    ],
)
def test_an_invalid_pose_is_answered_with_a_text_and_makes_no_request_to_the_robot(
    payload: bytes, words: str
) -> None:
    made = queries()
    replies = made.serve(query("srv/set_pose", payload=payload, fmt="json"), nothing, *NOW)
    assert isinstance(replies, list)
    (reply,) = replies
    assert reply.ok
    assert (reply.ticket, reply.key) == (7, "srv/set_pose")
    result = msgspec.json.decode(reply.payload, type=ServiceReply)
    assert not result.success
    assert words in result.message
    assert result.message.endswith('; send {"x": 0, "y": 0, "yaw": 0}')
    assert made.answered(Answer(7, True, ""), WALL_NS) is None


# ROS services

ASKED = Attachment(7, 1_600_000_000_000_000_000, bytes(range(16)))
EMPTY = b"\x00\x01\x00\x00\x00"


def ros_query(topic: str, via: str = "rmw", payload: bytes = EMPTY, **changes: Any) -> Query:
    fields: dict[str, Any] = {"via": via, "payload": payload, "arrived_ns": 99} | changes
    if via == "rmw":
        fields.setdefault("attachment", ASKED.pack())
    return query(topic, **fields)


@each("via", ["bridge", "rmw"])
@each("verb", PLAIN_SERVICES)
def test_a_ros_trigger_makes_a_request_to_the_robot_and_its_answer_is_cdr(
    verb: str, via: str
) -> None:
    made = queries()
    request = made.serve(ros_query(f"srv/{verb}", via), nothing, *NOW)
    by = f"unnamed (rmw {ASKED.gid.hex()})" if via == "rmw" else "unnamed (bridge)"
    assert request == Request(verb, 7, asked_ns=99, by=by)  # type: ignore[arg-type]
    reply = made.answered(Answer(7, True, "done"), WALL_NS)
    assert reply is not None
    assert Cdr(Trigger).decode(reply.payload) == Trigger(True, "done")
    assert reply.ok


def test_over_rmw_a_reply_has_the_sequence_and_gid_of_the_request_and_its_own_stamp() -> None:
    made = queries()
    made.serve(ros_query("srv/clear"), nothing, *NOW)
    reply = made.answered(Answer(7, False, "no"), WALL_NS)
    assert reply is not None
    assert unpack(reply.attachment) == Attachment(7, WALL_NS, ASKED.gid)


def test_a_reply_through_a_bridge_has_no_attachment() -> None:
    made = queries()
    made.serve(ros_query("srv/clear", "bridge", attachment=b"rqh" + bytes(17)), nothing, *NOW)
    reply = made.answered(Answer(7, True, ""), WALL_NS)
    assert reply is not None
    assert reply.attachment == b""


@each("payload", [b"", EMPTY[:4], EMPTY, EMPTY + bytes(3)])
def test_a_ros_trigger_accepts_a_request_of_any_length(payload: bytes) -> None:
    request = queries().serve(ros_query("srv/stop", "bridge", payload), nothing, *NOW)
    assert isinstance(request, Request)


@each("topic", ["srv/clear", "parameters/list_parameters"])
@each("attachment", [b"", bytes(20)])
def test_over_rmw_a_request_without_a_valid_attachment_is_not_answered(
    topic: str, attachment: bytes
) -> None:
    made = queries()
    with pytest.raises(DecodeError) as caught:
        made.serve(ros_query(topic, attachment=attachment), nothing, *NOW)
    assert caught.value.reason == ("bad_attachment" if attachment else "no_attachment")
    assert made.answered(Answer(7, True, ""), WALL_NS) is None


@pytest.mark.parametrize("via", ["bridge", "rmw"])
def test_the_parameter_services_return_the_configuration(via: str) -> None:
    payload = Cdr(rcl.Names).encode(rcl.Names(["robot.id"]))
    (reply,) = reply_to(ros_query("parameters/get_parameters", via, payload))
    (value,) = Cdr(rcl.Values).decode(reply.payload).values
    assert value.string_value == "r7"
    if via == "rmw":
        assert unpack(reply.attachment) == Attachment(7, OUTPUTS.now.wall_ns, ASKED.gid)
    else:
        assert reply.attachment == b""


@each("via", ["bridge", "rmw"])
@each("service", PARAMETER_SERVICES)
def test_an_unreadable_parameter_request_is_answered_with_a_refusal(service: str, via: str) -> None:
    asked = ros_query(f"parameters/{service}", via, payload=b"\x00")
    with pytest.raises(DecodeError) as caught:
        queries().serve(asked, nothing, *NOW)
    assert caught.value.reason == "malformed"
    reply = refused(asked, str(caught.value), WALL_NS)
    assert reply is not None
    kinds: dict[str, tuple[type[Any], Any]] = {
        "list_parameters": (rcl.ListReply, rcl.ListReply([], [])),
        "get_parameters": (rcl.Values, rcl.Values([])),
        "get_parameter_types": (rcl.Types, rcl.Types([])),
        "describe_parameters": (rcl.Descriptors, rcl.Descriptors([])),
        "set_parameters": (rcl.SetReply, rcl.SetReply([NO])),
        "set_parameters_atomically": (rcl.SetAtomicallyReply, rcl.SetAtomicallyReply(NO)),
    }
    kind, expected = kinds[service]
    assert Cdr(kind).decode(reply.payload) == expected
    echo = Attachment(7, WALL_NS, ASKED.gid).pack()
    assert (reply.ok, reply.attachment) == (True, echo if via == "rmw" else b"")


@pytest.mark.parametrize("service", rcl.SETTING_SERVICES)
def test_a_parameter_set_twice_in_a_request_is_refused_with_all_its_results(
    service: str,
) -> None:
    wishes = [
        rcl.Parameter("limits.linear_speed", rcl.ParameterValue(rcl.DOUBLE, double_value=value))
        for value in (0.7, 0.3)
    ]
    payload = Cdr(rcl.SetRequest).encode(rcl.SetRequest(wishes))
    asked = ros_query(f"parameters/{service}", "rmw", payload)
    with pytest.raises(
        DecodeError, match=r"limits\.linear_speed is in the request twice"
    ) as caught:
        queries().serve(asked, nothing, *NOW)
    reply = refused(asked, str(caught.value), WALL_NS)
    assert reply is not None
    no = rcl.SetParametersResult(False, str(caught.value))
    if service == "set_parameters":
        assert Cdr(rcl.SetReply).decode(reply.payload) == rcl.SetReply([no, no])
    else:
        assert Cdr(rcl.SetAtomicallyReply).decode(reply.payload) == rcl.SetAtomicallyReply(no)


def test_a_parameter_request_with_too_many_names_is_refused() -> None:
    names = ["robot.id"] * 256
    payload = Cdr(rcl.Names).encode(rcl.Names(names))
    (reply,) = reply_to(ros_query("parameters/get_parameters", payload=payload))
    values = Cdr(rcl.Values).decode(reply.payload).values
    assert [value.string_value for value in values] == ["r7"] * 256
    for more, reason in ((names + names[:1], "malformed"), (["x" * 20_000], "too_big")):
        payload = Cdr(rcl.Names).encode(rcl.Names(more))[: most_bytes("parameters/") + 1]
        with pytest.raises(DecodeError) as caught:
            queries().serve(ros_query("parameters/get_parameters", payload=payload), nothing, *NOW)
        assert caught.value.reason == reason


@pytest.mark.parametrize("via", ["bridge", "rmw"])
def test_a_rejected_ros_trigger_gets_a_reply_with_the_reason(via: str) -> None:
    reply = refused(ros_query("srv/clear", via), BUSY, WALL_NS)
    assert reply is not None
    assert (reply.ok, reply.key, reply.ticket) == (True, "srv/clear", 7)
    assert Cdr(Trigger).decode(reply.payload) == Trigger(False, BUSY)


def test_a_rejected_native_query_gets_an_error_with_the_reason() -> None:
    reply = refused(query("odom"), BUSY, WALL_NS, BUSY_ENCODING)
    assert reply is not None
    assert (reply.ok, reply.payload, reply.encoding) == (False, BUSY.encode(), "text/plain;busy")


def test_over_rmw_a_rejected_request_without_an_attachment_gets_no_reply() -> None:
    assert refused(ros_query("srv/clear", attachment=b""), BUSY, WALL_NS) is None


@each("via", ["bridge", "rmw"])
@each("service", rcl.SETTING_SERVICES)
def test_a_request_to_set_parameters_goes_to_the_robot_and_returns_its_answer(
    service: str, via: str
) -> None:
    value = rcl.ParameterValue(rcl.DOUBLE, double_value=0.7)
    payload = Cdr(rcl.SetRequest).encode(
        rcl.SetRequest([rcl.Parameter("limits.linear_speed", value)])
    )
    made = queries()
    request = made.serve(ros_query(f"parameters/{service}", via, payload), nothing, *NOW)
    assert isinstance(request, Request)
    assert (request.verb, request.id, request.settings) == ("set", 7, {"limits.linear_speed": 0.7})
    reply = made.answered(Answer(7, False, "call srv/clear first"), WALL_NS)
    assert reply is not None
    no = rcl.SetParametersResult(False, "call srv/clear first")
    if service == "set_parameters":
        assert Cdr(rcl.SetReply).decode(reply.payload) == rcl.SetReply([no])
    else:
        assert Cdr(rcl.SetAtomicallyReply).decode(reply.payload) == rcl.SetAtomicallyReply(no)
    echo = Attachment(7, WALL_NS, ASKED.gid).pack()
    assert reply.attachment == (echo if via == "rmw" else b"")


def test_config_and_the_parameter_services_return_a_changed_setting() -> None:
    made = queries()
    made.config = replace(CONFIG, limits=LimitsConfig(linear_speed=0.7))
    (config_reply,) = made.serve(query("config"), nothing, *NOW)  # type: ignore[misc]
    assert from_builtins(msgspec.json.decode(config_reply.payload)).limits.linear_speed == 0.7
    payload = Cdr(rcl.Names).encode(rcl.Names(["limits.linear_speed"]))
    asked = ros_query("parameters/get_parameters", "bridge", payload)
    (reply,) = made.serve(asked, nothing, *NOW)  # type: ignore[misc]
    assert Cdr(rcl.Values).decode(reply.payload).values[0].double_value == 0.7


def reply_to(asked: Query) -> list[Reply]:
    replies = queries().serve(asked, nothing, *NOW)
    assert isinstance(replies, list)
    return replies
