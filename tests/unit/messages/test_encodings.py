"""msgpack and JSON by name and by first byte; whatever comes, only `DecodeError` goes up."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.messages.encodings import (
    FORMATS,
    DecodeError,
    Decoder,
    Format,
    detect,
    encode,
    encoding_name,
)
from acsard.messages.schema import Twist, Vector3

TWIST = Twist(Vector3(0.5), Vector3(z=0.2))
AS_JSON = b'{"linear":{"x":0.5,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":0.2}}'

twists = Decoder(Twist)


def refusal(encoding: str, payload: bytes) -> str:
    with pytest.raises(DecodeError) as caught:
        twists.decode(encoding, payload)
    return caught.value.reason


def test_an_encoding_names_the_format_the_type_and_its_version() -> None:
    assert encoding_name("msgpack", "Odometry") == "application/msgpack;acsard.Odometry.v1"
    assert encoding_name("json", "Odometry") == "application/json;acsard.Odometry.v1"
    assert encoding_name("json") == "application/json"


def test_json_is_the_maps_of_the_ros_message() -> None:
    assert encode(TWIST, "json") == AS_JSON


def test_msgpack_is_the_same_maps() -> None:
    assert msgspec.msgpack.decode(encode(TWIST, "msgpack")) == msgspec.json.decode(AS_JSON)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("named", [True, False])
def test_a_message_comes_back_with_and_without_its_encoding(form: Format, named: bool) -> None:
    encoding = encoding_name(form, "Twist") if named else ""
    assert twists.decode(encoding, encode(TWIST, form)) == TWIST


@pytest.mark.parametrize(
    ("encoding", "form"),
    [
        ("application/json", "json"),
        ("application/json;acsard.Twist.v1", "json"),
        ("text/json", "json"),
        ("application/msgpack", "msgpack"),
        ("application/msgpack;whatever", "msgpack"),
    ],
)
@pytest.mark.parametrize("payload", [AS_JSON, encode(TWIST, "msgpack"), b"", b"\xff"])
def test_an_encoding_that_says_so_is_believed(encoding: str, form: str, payload: bytes) -> None:
    assert detect(encoding, payload) == form


@pytest.mark.parametrize("encoding", ["", "zenoh/bytes", "text/plain", "zenoh/string", "x"])
@pytest.mark.parametrize(
    ("payload", "form"),
    [
        (b"{}", "json"),
        (b" \t\r\n{", "json"),
        (b"\x80", "msgpack"),
        (b"\x82\xa1", "msgpack"),
        (b"\x8f", "msgpack"),
        (b"\xde\x00\x10", "msgpack"),
        (b"\xdf\x00\x00\x00\x10", "msgpack"),
    ],
)
def test_without_one_the_first_byte_decides(encoding: str, payload: bytes, form: str) -> None:
    assert detect(encoding, payload) == form


@pytest.mark.parametrize(
    "payload",
    [b"", b"   ", b"[1]", b'"stop"', b"1", b"null", b"\x90", b"\x93\x01", b"\x7f", b"\xa1x",
     b"\xc0", b"\xdc\x00\x00", b"\xdd", b"\x00\x01\x00\x00", b"\xef\xbb\xbf{}"],
)  # fmt: skip
def test_what_is_neither_a_json_object_nor_a_msgpack_map_is_not_guessed(payload: bytes) -> None:
    assert refusal("", payload) == "unknown_encoding"


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b'{"linear":{}}', "wrong_shape"),
        (b'{"angular":{},"linear":{},"x":1}', "wrong_shape"),
        (b'{"linear":{"X":1},"angular":{}}', "wrong_shape"),
        (b'{"linear":{"x":"1"},"angular":{}}', "wrong_shape"),
        (b'{"linear":null,"angular":{}}', "wrong_shape"),
        (b'{"linear":[0.5,0,0],"angular":{}}', "wrong_shape"),
        (b'{"linear":{"x":1e999},"angular":{}}', "wrong_shape"),
        (b'{"linear":{"x":NaN},"angular":{}}', "malformed"),
        (b'{"linear":{"x":Infinity},"angular":{}}', "malformed"),
        (b'{"linear":{},"angular":{}', "malformed"),
        (b'{"linear":{},"angular":{}} x', "malformed"),
        (b'{"linear":{},"angular":{},"\xff":1}', "malformed"),
        (b"{", "malformed"),
    ],
)
def test_json_that_is_not_the_message_is_refused_by_reason(payload: bytes, reason: str) -> None:
    assert refusal("", payload) == reason


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x80", "wrong_shape"),
        (b"\x81\xa6linear\x80", "wrong_shape"),
        (b"\x82\xa6linear\x80\xa7angular\xc0", "wrong_shape"),
        (b"\x82\xa6linear\x81\xa1x\xa11\xa7angular\x80", "wrong_shape"),
        (b"\x82\x01\x80\x02\x80", "wrong_shape"),
        (b"\x82\xa6linear\x80", "malformed"),
        (b"\x82\xa6linear\x80\xa7angular\x80\x00", "malformed"),
        (b"\xdf\xff\xff\xff\xff", "malformed"),
        (b"\x81\xdb\xff\xff\xff\xff", "malformed"),
        (b"\x82\xa1\xff\x80\xa7angular\x80", "malformed"),
        (b"\xc1", "malformed"),
    ],
)
def test_msgpack_that_is_not_the_message_is_refused_by_reason(payload: bytes, reason: str) -> None:
    assert refusal("application/msgpack", payload) == reason


def test_a_payload_of_the_other_format_than_it_says_is_refused() -> None:
    assert refusal("application/msgpack", AS_JSON) in ("malformed", "wrong_shape")
    assert refusal("application/json", encode(TWIST, "msgpack")) == "malformed"


@pytest.mark.parametrize("depth", [10, 1000, 100_000])
@pytest.mark.parametrize(
    ("start", "nested"),
    [
        (b"", b'{"linear":'),
        (b'{"linear":', b"["),
        (b'{"x":', b"["),
        (b"", b'{"x":'),
        (b"", b"\x81\xa6linear"),
        (b"\x81\xa6linear", b"\x91"),
        (b"\x81\xa1x", b"\x91"),
        (b"\x81", b"\x91"),
        (b"", b"\x81"),
    ],
)
def test_deep_nesting_is_refused(start: bytes, nested: bytes, depth: int) -> None:
    assert refusal("", start + nested * depth) in ("wrong_shape", "malformed")


@pytest.mark.parametrize("form", FORMATS)
def test_deep_nesting_is_refused_also_where_any_value_is_welcome(form: Format) -> None:
    anything = Decoder(dict[str, object])
    deep = b'{"x":' * 50_000 if form == "json" else b"\x81\xa1x" * 50_000
    with pytest.raises(DecodeError) as caught:
        anything.decode("", deep)
    assert caught.value.reason == "malformed"


@given(st.binary(max_size=80), st.sampled_from(["", "application/json", "application/msgpack"]))
@settings(max_examples=300)
def test_any_bytes_are_a_message_or_a_decode_error(payload: bytes, encoding: str) -> None:
    try:
        got = twists.decode(encoding, payload)
    except DecodeError:
        return
    assert isinstance(got, Twist)


axis = st.floats(allow_nan=False, allow_infinity=False)
vector = st.builds(Vector3, axis, axis, axis)


@given(st.builds(Twist, vector, vector), st.sampled_from(FORMATS))
def test_every_finite_twist_comes_back_bit_for_bit(twist: Twist, form: Format) -> None:
    assert twists.decode("", encode(twist, form)) == twist
