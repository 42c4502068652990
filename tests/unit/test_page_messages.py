"""Every message of `/ws` matches its schema, and any other one is refused."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.messages.encodings import encode
from acsard.core.messages.report import Report
from acsard.core.messages.schema import Beat
from acsard.web import socket_messages
from acsard.web.openapi import KEYS, VALUE_PREFIX
from acsard.web.socket_messages import (
    MAX_STAMP_MS,
    Call,
    Command,
    FrameError,
    Ping,
    Subscribe,
    Unsubscribe,
    Wish,
    asks_to_stop,
    decode,
)
from acsard.web.socket_sender import Following
from acsard.web.streams import VIEWER_KEYS as FOLLOWED
from acsard.web.streams import Stream
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, due
from tests.unit.page_schemas import FRAMES, SCHEMAS, is_described_frame, kinds, spoilt

COMMAND = {"cmd": {"linear_x": 0.2, "angular_z": -0.1}, "stamp": 1763700000123.4}


def test_each_kind_of_message_is_recognized_by_its_field() -> None:
    assert decode(json.dumps(COMMAND)) == Command(Wish(0.2, -0.1), 1763700000123.4)
    echoed = {"cmd": COMMAND["cmd"], "echo": {"run": 7, "boot_us": 5}}
    assert decode(json.dumps(echoed)) == Command(Wish(0.2, -0.1), echo=Beat(7, 5))
    assert decode('{"subscribe": "odom"}') == Subscribe("odom", 10.0)
    assert decode('{"unsubscribe": "odom"}') == Unsubscribe("odom")
    assert decode('{"call": "stop", "id": 7}') == Call("stop", 7)
    assert decode('{"call": "set", "payload": {"a": 1}, "id": "x"}') == Call("set", "x", {"a": 1})
    assert decode('{"ping": 12.5}') == Ping(12.5)


def test_the_stamp_of_a_command_is_in_milliseconds() -> None:
    frame = decode(json.dumps(COMMAND))
    assert isinstance(frame, Command)
    assert frame.stamp_ns == pytest.approx(1763700000123.4 * 1e6, abs=1e5)
    without = decode(json.dumps({"cmd": COMMAND["cmd"]}))
    assert isinstance(without, Command)
    assert without.stamp_ns is None


@each("stamp", [9.3e12, 1.8e13, 2.0**51, MAX_STAMP_MS])
def test_a_stamp_that_no_signature_holds_is_refused(stamp: float) -> None:
    with pytest.raises(FrameError, match="stamp"):
        decode(json.dumps(COMMAND | {"stamp": stamp}))


@each(
    ("text", "about"),
    [
        ("", "message"), ("[]", "message"), ("{}", "message"), ('"stop"', "message"),
        ('{"go": 1}', "message"), ('{"ping": 1, "call": "stop"}', "message"),
        ('{"cmd": {"linear_x": 0.2}, "stamp": 1}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0, "linear_y": 1}, "stamp": 1}', "cmd"),
        ('{"cmd": {"linear_x": NaN, "angular_z": 0}, "stamp": 1}', "message"),
        ('{"cmd": {"linear_x": 1e999, "angular_z": 0}, "stamp": 1}', "cmd"),
        ('{"cmd": {"linear_x": "0.2", "angular_z": 0}, "stamp": 1}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "echo": [1, 2]}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "echo": {"run": -1, "boot_us": 2}}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "stamp": 0}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "stamp": -5}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "stamp": 1e300}', "cmd"),
        ('{"cmd": {"linear_x": 0.2, "angular_z": 0}, "stamp": 1, "sender": "you"}', "cmd"),
        ('{"subscribe": "odom", "rate": 0}', "subscribe"),
        ('{"subscribe": "odom", "rate": 51}', "subscribe"), ('{"subscribe": 1}', "subscribe"),
        ('{"call": "stop", "payload": []}', "call"), ("[" * 5000 + "]" * 5000, "message"),
    ],
)  # fmt: skip
def test_an_invalid_message_is_refused_with_the_kind_it_was_meant_as(text: str, about: str) -> None:
    with pytest.raises(FrameError) as caught:
        decode(text)
    assert caught.value.about == about
    assert str(caught.value)


INVALID_STOPS = [
    '{"call": "stop", "id": null}', '{"call": "stop", "id": 1e999}', '{"call": "stop", "id": true}',
    '{"call": "stop", "id": 1, "payload": []}', '{"call": "stop", "id": 1, "payload": null}',
    '{"call": "stop", "id": 1, "extra": 1}', '{"call": "stop", "id": 1, "subscribe": "odom"}',
]  # fmt: skip
"""Invalid messages that ask the robot to stop."""


@each("text", INVALID_STOPS)
def test_an_invalid_message_that_asks_for_a_stop_is_recognized(text: str) -> None:
    assert asks_to_stop(text)
    assert not asks_to_stop(text.replace('"stop"', '"clear"'))


@given(st.text())
def test_any_text_decodes_or_raises_a_frame_error(text: str) -> None:
    try:
        decode(text)
    except FrameError:
        pass
    assert not asks_to_stop(text)


GREETING = socket_messages.Greeting(
    "acsar", "1", "operator", "phone/1f", socket_messages.Limits(1.0, 4.0), True, 10.0,
    {"set": "for maintainers; your role is operator"}, False,
)  # fmt: skip

SAID: tuple[Struct, ...] = (
    socket_messages.Hello(GREETING), socket_messages.DrivenPath([(0.0, 1.5)]),
    socket_messages.Answer(7, True, "stopped"), socket_messages.Pong(12.5, 1e12),
    socket_messages.Refused("cmd", "why"), socket_messages.DaemonUnreachable("why"),
)  # fmt: skip


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
