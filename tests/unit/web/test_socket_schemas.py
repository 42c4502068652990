"""Every message of `/ws` matches one of its schemas, and a damaged message matches no schema."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest
from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.messages.encodings import encode
from acsard.core.messages.report import Report
from acsard.core.values import Role
from acsard.web import socket_messages
from acsard.web.openapi import KEYS, SENT_MESSAGES, VALUE_PREFIX
from acsard.web.socket_sender import Following
from acsard.web.streams import VIEWER_KEYS as FOLLOWED
from acsard.web.streams import Stream
from tests.each import each
from tests.unit.core.messages.examples import OUTPUTS, SNAPSHOT, START, due
from tests.unit.web.described import FRAMES, SCHEMAS, is_described_frame, kinds, spoilt

GREETING = socket_messages.Greeting(
    "acsar", "1", "operator", "phone/1f", socket_messages.Limits(1.0, 4.0), True, 10.0,
    {"set": "for maintainers; your role is operator"}, False, "",
)  # fmt: skip

SAID: tuple[Struct, ...] = (
    socket_messages.Hello(GREETING),
    socket_messages.DrivenPath([(0.0, 1.5)]),
    socket_messages.Answer(7, True, "stopped"),
    socket_messages.Pong(12.5, 1e12),
    socket_messages.Refused("cmd", "why"),
    socket_messages.DaemonUnreachable("why"),
)


def as_sent(message: object) -> Any:
    return msgspec.json.decode(msgspec.json.encode(message))


def test_every_key_that_may_be_followed_is_described() -> None:
    assert set(KEYS) == FOLLOWED
    assert {
        name.removeprefix(VALUE_PREFIX) for name in FRAMES if name.startswith(VALUE_PREFIX)
    } == {key.replace("/", ".") for key in KEYS}


@each("message", SAID)
def test_each_sent_message_matches_its_schema_only_if_it_is_complete(message: Struct) -> None:
    frame = as_sent(message)
    assert kinds([frame]) == {type(message).__name__}
    assert [variant for variant in spoilt(frame) if is_described_frame(variant)] == []


def test_each_kind_of_sent_message_has_an_example() -> None:
    assert {type(message) for message in SAID} == set(SENT_MESSAGES)


@pytest.mark.parametrize("role", get_args(Role))
def test_a_greeting_may_have_only_an_existing_role(role: Role) -> None:
    hello = as_sent(socket_messages.Hello(msgspec.structs.replace(GREETING, role=role)))
    assert is_described_frame(hello)
    assert not is_described_frame({"hello": hello["hello"] | {"role": "king"}})


def test_a_message_of_a_key_has_its_type_by_reference() -> None:
    report = Report(Config(), START)
    list(due(report, OUTPUTS, {"odom"}, lambda: SNAPSHOT))
    odom = report.current("odom", lambda: SNAPSHOT)
    assert odom is not None
    head = Following("odom", 0.1, Stream()).head
    frame = as_sent(msgspec.Raw(b'%b%b,"age":1.5}' % (head, encode(odom, "json"))))
    assert kinds([frame, frame | {"value": None}]) == {"Value.odom"}
    assert [variant for variant in spoilt(frame) if is_described_frame(variant)] == []
    assert not is_described_frame(frame | {"key": "state"})
    assert SCHEMAS["Value.odom"]["properties"]["value"]["anyOf"][0] == {
        "$ref": "#/components/schemas/Odometry"
    }
