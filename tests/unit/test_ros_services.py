"""ROS services: triggers and parameters through a bridge and over rmw, and their refusals."""

from __future__ import annotations

from typing import Any

import pytest

from acsard.core.incoming.queries import (
    Query,
    Reply,
    most_bytes,
    refused,
)
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import PLAIN_SERVICES
from acsard.core.messages.refusals import BUSY, BUSY_ENCODING
from acsard.core.ros import parameters as rcl
from acsard.core.ros.attachments import Attachment, unpack
from acsard.core.ros.shapes import Trigger
from acsard.core.ros.transports import PARAMETER_SERVICES
from acsard.core.values import Answer, Request
from tests.each import each
from tests.unit.test_bus_queries import (
    DONE,
    EMPTY,
    WALL_NS,
    answer,
    queries,
    query,
    served,
)

CALL = Attachment(7, 1_600_000_000_000_000_000, bytes(range(16)))
VIAS = ("bridge", "rmw")


def ros_query(topic: str, via: str = "rmw", payload: bytes = EMPTY, **changes: Any) -> Query:
    fields: dict[str, Any] = {"via": via, "payload": payload, "arrived_ns": 99} | changes
    if via == "rmw":
        fields.setdefault("attachment", CALL.pack())
    return query(topic, **fields)


def echo(via: str, wall_ns: int = WALL_NS) -> Attachment | None:
    """Return the attachment of a reply: the request's sequence and GID, and an own stamp."""
    return Attachment(7, wall_ns, CALL.gid) if via == "rmw" else None


def attached(reply: Reply | None) -> Attachment | None:
    assert reply is not None
    assert reply.ok
    return unpack(reply.attachment) if reply.attachment else None


@each("via", VIAS)
@each("verb", PLAIN_SERVICES)
@each("payload", [b"", EMPTY[:4], EMPTY, EMPTY + bytes(3)])
def test_a_ros_trigger_of_any_length_makes_a_request_and_its_answer_is_cdr(
    verb: Any, via: str, payload: bytes
) -> None:
    made = queries()
    # What a bridge attaches is ignored.
    more = {} if via == "rmw" else {"attachment": b"rqh" + bytes(17)}
    by = f"unnamed (rmw {CALL.gid.hex()})" if via == "rmw" else "unnamed (bridge)"
    request = served(ros_query(f"srv/{verb}", via, payload, **more), made)
    assert request == Request(verb, 7, asked_ns=99, by=by)
    reply = made.answered(DONE, WALL_NS)
    assert reply is not None
    assert Cdr(Trigger).decode(reply.payload) == Trigger(True, "done")
    assert attached(reply) == echo(via)


@each("topic", ["srv/clear", "parameters/list_parameters"])
@each("attachment", [b"", bytes(20)])
def test_over_rmw_a_request_needs_a_valid_attachment(topic: str, attachment: bytes) -> None:
    made = queries()
    with pytest.raises(DecodeError) as caught:
        served(ros_query(topic, attachment=attachment), made)
    assert caught.value.reason == ("bad_attachment" if attachment else "no_attachment")
    assert made.answered(DONE, WALL_NS) is None
    assert refused(ros_query("srv/clear", attachment=b""), BUSY, WALL_NS) is None


def set_request(*wishes: float) -> bytes:
    return Cdr(rcl.SetRequest).encode(rcl.SetRequest([
        rcl.Parameter("limits.linear_speed", rcl.ParameterValue(rcl.DOUBLE, double_value=wish))
        for wish in wishes
    ]))  # fmt: skip


def results(service: str, payload: bytes) -> list[rcl.SetParametersResult]:
    if service == "set_parameters":
        return Cdr(rcl.SetReply).decode(payload).results
    return [Cdr(rcl.SetAtomicallyReply).decode(payload).result]


@each("via", VIAS)
@each("service", rcl.SETTING_SERVICES)
def test_a_request_to_set_parameters_returns_the_robot_s_answer(service: str, via: str) -> None:
    made = queries()
    request = served(ros_query(f"parameters/{service}", via, set_request(0.7)), made)
    assert isinstance(request, Request)
    assert (request.verb, request.id, request.settings) == ("set", 7, {"limits.linear_speed": 0.7})
    reply = made.answered(Answer(7, False, "stop first"), WALL_NS)
    assert reply is not None
    no = rcl.SetParametersResult(False, "stop first")
    assert results(service, reply.payload) == [no]
    assert attached(reply) == echo(via)
    # A parameter that is set twice is refused with all its results.
    twice = ros_query(f"parameters/{service}", via, set_request(0.7, 0.3))
    with pytest.raises(
        DecodeError, match=r"limits\.linear_speed is in the request twice"
    ) as caught:
        served(twice)
    reply = refused(twice, str(caught.value), WALL_NS)
    assert reply is not None
    no = rcl.SetParametersResult(False, str(caught.value))
    assert results(service, reply.payload) == [no] * (2 if service == "set_parameters" else 1)


NO = rcl.SetParametersResult(
    False, "the payload must begin with the header of plain CDR, not with 00"
)
NOTHING: dict[str, Any] = {
    "list_parameters": rcl.ListReply([], []), "get_parameters": rcl.Values([]),
    "get_parameter_types": rcl.Types([]), "describe_parameters": rcl.Descriptors([]),
    "set_parameters": rcl.SetReply([NO]), "set_parameters_atomically": rcl.SetAtomicallyReply(NO),
}  # fmt: skip


@each("via", VIAS)
@each("service", PARAMETER_SERVICES)
def test_an_unreadable_parameter_request_is_answered_with_a_refusal(service: str, via: str) -> None:
    asked = ros_query(f"parameters/{service}", via, payload=b"\x00")
    with pytest.raises(DecodeError) as caught:
        served(asked)
    assert caught.value.reason == "malformed"
    reply = refused(asked, str(caught.value), WALL_NS)
    assert reply is not None
    assert Cdr(type(NOTHING[service])).decode(reply.payload) == NOTHING[service]
    assert attached(reply) == echo(via)


def test_a_parameter_request_with_too_many_names_is_refused() -> None:
    names = ["robot.id"] * 256
    payload = Cdr(rcl.Names).encode(rcl.Names(names))
    reply = answer(ros_query("parameters/get_parameters", payload=payload))
    assert len(Cdr(rcl.Values).decode(reply.payload).values) == 256
    for more, reason in ((names + names[:1], "malformed"), (["x" * 20_000], "too_big")):
        payload = Cdr(rcl.Names).encode(rcl.Names(more))[: most_bytes("parameters/") + 1]
        with pytest.raises(DecodeError) as caught:
            served(ros_query("parameters/get_parameters", payload=payload))
        assert caught.value.reason == reason


def test_a_busy_daemon_refuses_in_the_form_that_the_caller_understands() -> None:
    for via in VIAS:
        reply = refused(ros_query("srv/clear", via), BUSY, WALL_NS)
        assert reply is not None
        assert (reply.ok, reply.key, reply.ticket) == (True, "srv/clear", 7)
        assert Cdr(Trigger).decode(reply.payload) == Trigger(False, BUSY)
    reply = refused(query("odom"), BUSY, WALL_NS, BUSY_ENCODING)
    assert reply is not None
    assert (reply.ok, reply.payload, reply.encoding) == (False, BUSY.encode(), "text/plain;busy")
