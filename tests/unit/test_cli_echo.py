"""`echo` prints a payload of any encoding as one line, each robot's share, and rates."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from acsard.cli import main
from acsard.cli.echo import _message_text, _print, _shortened
from acsard.cli.replies import json_line
from acsard.core.messages.encodings import (
    DecodeError,
    Decoder,
    Format,
    encode,
    encoding_name,
)
from acsard.core.messages.schema import (
    Header,
    Odometry,
    PoseStamped,
    RobotState,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.host.errors import Exit
from tests.each import each

BODY = {"linear": {"x": 0.5}, "name": ["ä", "b\n"], "n": -3, "ok": True, "none": None}


@each("form", ["json", "msgpack"])
@each("named", [True, False])
def test_a_message_is_its_json_on_one_line(form: Format, named: bool) -> None:
    line = json_line(encoding_name(form, "State") if named else "", encode(BODY, form))
    assert msgspec.json.decode(line) == BODY
    assert "\n" not in line


@each(
    ("encoding", "payload"),
    [
        ("", b""), ("", b"stop"), ("", b"[1]"), ("", b'{"a":'), ("", b'{"a":1} x'),
        ("", b'{"a":"\xff"}'), ("", b"\x81\xa1a"), ("", b"\x81\xa1a\xa1\xff"),
        ("", b"\x00\x01\x00\x00"), ("application/json", b"\x80"), ("application/msgpack", b"\xc1"),
        ("application/msgpack", b"{}"), ("application/cdr", b""), ("application/cdr", b"\x05"),
        ("application/cdr", b"\x81\xa1a\x01"),
    ],
)  # fmt: skip
def test_an_undecodable_payload_is_shown_as_its_bytes(encoding: str, payload: bytes) -> None:
    assert msgspec.json.decode(json_line(encoding, payload)) == {"undecodable": repr(payload)}


@each(
    "payload",
    [
        msgspec.msgpack.encode({None: 1}),
        msgspec.msgpack.encode({(1, 2): 1}),
        msgspec.msgpack.encode({"a": msgspec.msgpack.Ext(5, b"x")}),
        b'{"a":' + b"[" * 3000 + b"]" * 3000 + b"}",
        b"\x81\xa1a" + b"\x91" * 3000 + b"\xc0",
    ],
)
def test_echo_survives_any_payload(payload: bytes) -> None:
    assert json_line("", payload).isprintable()


def printed(robots: str, senders: str, most: int | None) -> int:
    """Print the messages of these senders in order, and return the exit code."""
    samples: Any = [
        SimpleNamespace(
            key_expr=f"acsard/{sender}/state",
            encoding="application/json",
            payload=SimpleNamespace(to_bytes=lambda: b"{}"),
        )
        for sender in senders
    ]
    silence: Any = SimpleNamespace(heard=lambda: None, explain=lambda: None)
    return _print(iter(samples), None, most, robots, silence)


@pytest.mark.parametrize(
    ("robots", "senders", "most", "code", "ids"),
    [
        ("abc", "aaabac", 1, 0, "abc"),
        ("abc", "aabbaccab", 2, 0, "aabbcc"),
        ("ab", "aacb", 1, 0, "acb"),
        ("", "ba", 1, 0, "b"),
        ("abc", "aaab", 1, 1, "ab"),
        ("ab", "aaab", None, 1, "aaab"),
        # Without a number, a robot that joined after the start does not end the command.
        ("ab", "cab", None, 1, "cab"),
    ],
)
def test_a_number_of_messages_counts_for_each_robot(
    robots: str, senders: str, most: int | None, code: int, ids: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert printed(robots, senders, most) == code
    lines = capsys.readouterr().out.splitlines()
    assert "".join(msgspec.json.decode(line)["robot"] for line in lines) == ids


def test_a_key_without_a_short_form_is_refused_with_those_that_have_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["echo", "tf", "--short"]) == Exit.USAGE
    output = capsys.readouterr().err
    assert "tf has no short form" in output
    assert all(key in output for key in ("odom", "state", "cmd_vel_out", "sim/pose"))
    for key, kind in (("odom", Odometry), ("sim/pose", PoseStamped), ("state", RobotState)):
        name = encoding_name("json", kind.__name__)
        with pytest.raises(DecodeError, match="missing required field"):
            _shortened(key).decode(name, b"{}")


@each("form", ["json", "msgpack"])
@each("whose", ["", "robot1"])
def test_a_short_line_of_several_robots_begins_with_the_robot(form: Format, whose: str) -> None:
    twist = TwistStamped(Header(), Twist(Vector3(0.5), Vector3(z=0.2)))
    payload = encode(twist, form)
    line = _message_text(Decoder(TwistStamped), encoding_name(form, "TwistStamped"), payload, whose)
    assert line == f"{whose}{': ' if whose else ''}forward +0.50 m/s  turn +0.20 rad/s"


def test_a_message_without_a_short_form_is_shown_as_its_json() -> None:
    decoder = Decoder(TwistStamped)
    assert _message_text(decoder, "", b'{"a": 1}', "") == '{"a":1}'
    assert msgspec.json.decode(_message_text(decoder, "", b"\xff", "")) == {
        "undecodable": repr(b"\xff")
    }
