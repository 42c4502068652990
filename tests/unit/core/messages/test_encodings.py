"""The daemon recognizes msgpack, JSON and CDR by their names or by the first bytes.

Bad input raises `DecodeError` and no other error.
"""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import Config
from acsard.core.messages.encodings import (
    FORMATS,
    DecodeError,
    Decoder,
    Format,
    StrictDecoder,
    detect,
    encode,
    encoding_name,
)
from acsard.core.messages.report import Report
from acsard.core.messages.schema import (
    Change,
    Header,
    Info,
    JointState,
    Message,
    Release,
    ReplyData,
    RobotState,
    ServiceReply,
    SetPose,
    Settings,
    TFMessage,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from tests.each import each
from tests.unit.core.messages.examples import OUTPUTS, SNAPSHOT, START, due

TWIST = Twist(Vector3(0.5), Vector3(z=0.2))
AS_CDR = b"\x00\x01\x00\x00" + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0.2)
AS_JSON = b'{"linear":{"x":0.5,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":0.2}}'

twists = Decoder(Twist)
received_twists = StrictDecoder(Twist)


def refusal(encoding: str, payload: bytes) -> str:
    with pytest.raises(DecodeError) as caught:
        received_twists.decode(encoding, payload)
    return caught.value.reason


def grown(value: Any) -> Any:
    """Return the message with one more field in each of its parts."""
    match value:
        case msgspec.Struct():
            fields = {name: grown(getattr(value, name)) for name in value.__struct_fields__}
            return fields | {"later": {"deep": [1]}}
        case list() | tuple():
            return [grown(item) for item in value]
        case dict():
            return {key: grown(item) for key, item in value.items()}
    return value


REPORT = Report(Config(), START)
list(due(REPORT, OUTPUTS, {"state"}, lambda: SNAPSHOT))
MESSAGES = [
    *(REPORT.current(key, lambda: SNAPSHOT) for key in ("odom", "tf", "state", "diagnostics")),
    ServiceReply(True, "done", ReplyData([7], {"rates.odom": Change(1.0, 2.0)})),
    TwistStamped(Header(Time(1, 2), "odom"), TWIST),
    JointState(name=["a"], velocity=[1.0]),
    Release([7]),
    SetPose(1.0, 2.0, 3.0),
    Settings({"rates.odom": 5.0}),
]


@each("message", MESSAGES)
@each("form", ["json", "msgpack"])
def test_a_client_ignores_unknown_fields_and_the_daemon_refuses_them(
    message: Message, form: Format
) -> None:
    plain, more, kind = encode(message, form), encode(grown(message), form), type(message)
    assert Decoder(kind).decode("", more) == message
    received = StrictDecoder(kind).decode("", plain)
    assert isinstance(received, kind)
    assert msgspec.to_builtins(received) == msgspec.to_builtins(message)
    with pytest.raises(DecodeError, match="unknown field `later`"):
        StrictDecoder(kind).decode("", more)


@each("payload", [b'{"header":{"stamp":{"Sec":1}},"twist":{}}', b'{"transforms":[{"x":1}]}'])
def test_the_daemon_refuses_an_unknown_field_in_a_part_of_a_message(payload: bytes) -> None:
    kind = TwistStamped if b"twist" in payload else TFMessage
    with pytest.raises(DecodeError, match="unknown field"):
        StrictDecoder(kind).decode("", payload)


def test_an_encoding_names_the_format_the_type_and_its_version() -> None:
    assert encoding_name("msgpack", "Odometry") == "application/msgpack;acsard.Odometry.v1"
    assert encoding_name("json", "Odometry") == "application/json;acsard.Odometry.v1"
    assert encoding_name("cdr", "Odometry") == "application/cdr;acsard.Odometry.v1"
    assert encoding_name("json") == "application/json"
    assert encoding_name("cdr") == "application/cdr"


def test_json_has_the_fields_of_the_ros_message_as_maps() -> None:
    assert encode(TWIST, "json") == AS_JSON


def test_msgpack_has_the_same_maps_as_json() -> None:
    assert msgspec.msgpack.decode(encode(TWIST, "msgpack")) == msgspec.json.decode(AS_JSON)


def test_cdr_is_a_header_of_four_bytes_and_the_fields() -> None:
    assert encode(TWIST, "cdr") == AS_CDR


@each(
    "value",
    [
        {"x": 0.5},
        [0.5],
        0.5,
        None,
        Info("r7", "1.2.3", 42, "/dev/x", True, 100.0, [], []),
        RobotState(Time(), "", "", 0, 0, 0, 0, 0, [], "", "", [], "", {}),
    ],
)
def test_a_value_that_is_not_a_ros_message_cannot_be_encoded_as_cdr(value: object) -> None:
    with pytest.raises(DecodeError, match=f"{type(value).__name__} is not a ROS message") as caught:
        encode(value, "cdr")
    assert caught.value.reason == "unknown_format"


@each("cls", [dict, Info, RobotState])
@each("encoding", ["", "application/cdr"])
def test_a_type_that_is_not_a_ros_message_is_not_decoded_from_cdr(
    cls: type[object], encoding: str
) -> None:
    with pytest.raises(DecodeError) as caught:
        Decoder(cls).decode(encoding, AS_CDR)
    assert caught.value.reason == "unknown_format"


@each("form", FORMATS)
@each("named", [True, False])
def test_a_message_is_decoded_with_and_without_the_name_of_its_encoding(
    form: Format, named: bool
) -> None:
    encoding = encoding_name(form, "Twist") if named else ""
    assert twists.decode(encoding, encode(TWIST, form)) == TWIST


@each(
    ("encoding", "form"),
    [
        ("application/json", "json"),
        ("application/json;acsard.Twist.v1", "json"),
        ("text/json", "json"),
        ("application/msgpack", "msgpack"),
        ("application/msgpack;whatever", "msgpack"),
        ("application/cdr", "cdr"),
        ("application/cdr;acsard.Twist.v1", "cdr"),
        ("application/cdr;whatever", "cdr"),
    ],
)
@each("payload", [AS_JSON, encode(TWIST, "msgpack"), AS_CDR, b"", b"\xff"])
def test_a_named_encoding_determines_the_format(encoding: str, form: str, payload: bytes) -> None:
    assert detect(encoding, payload) == form


@each("encoding", ["", "zenoh/bytes", "text/plain", "zenoh/string", "x"])
@each(
    ("payload", "form"),
    [
        (b"{}", "json"),
        (b" \t\r\n{", "json"),
        (b"\x80", "msgpack"),
        (b"\x82\xa1", "msgpack"),
        (b"\x8f", "msgpack"),
        (b"\xde\x00\x10", "msgpack"),
        (b"\xdf\x00\x00\x00\x10", "msgpack"),
        (b"\x00\x00", "cdr"),
        (b"\x00\x01", "cdr"),
        (b"\x00\x00\x00\x00", "cdr"),
        (b"\x00\x01\x00\x03", "cdr"),
        (b"\x00\x01\xff\xff{}", "cdr"),
    ],
)
def test_without_a_named_encoding_the_first_bytes_determine_the_format(
    encoding: str, payload: bytes, form: str
) -> None:
    assert detect(encoding, payload) == form


@each(
    "payload",
    [b"", b"   ", b"[1]", b'"stop"', b"1", b"null", b"\x90", b"\x93\x01", b"\x7f", b"\xa1x",
     b"\xc0", b"\xdc\x00\x00", b"\xdd", b"\x00", b"\x00\x02\x00\x00",
     b"\x00\x03\x00\x00", b"\x01\x00\x00\x00", b"\x00\x07\x00\x00", b"\n\x00\x01",
     b"\xef\xbb\xbf{}"],
)  # fmt: skip
def test_bytes_that_match_no_format_are_refused_as_unknown_encoding(payload: bytes) -> None:
    assert refusal("", payload) == "unknown_encoding"


@each(
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
def test_json_that_is_not_the_message_is_refused_with_the_reason(
    payload: bytes, reason: str
) -> None:
    assert refusal("", payload) == reason


@each(
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
def test_msgpack_that_is_not_the_message_is_refused_with_the_reason(
    payload: bytes, reason: str
) -> None:
    assert refusal("application/msgpack", payload) == reason


@each(
    "payload",
    [
        b"",
        b"\x00\x01",
        b"\x00\x01\x00",
        b"\x00\x01\x00\x00",
        b"\x00\x02" + AS_CDR[2:],
        b"\x00\x03" + AS_CDR[2:],
        AS_CDR[4:],
        AS_CDR[:-1],
        AS_CDR[:-8],
    ],
)
def test_cdr_that_is_not_the_message_is_refused_as_malformed(payload: bytes) -> None:
    assert refusal("application/cdr", payload) == "malformed"


@each("surplus", [1, 3, 4, 7, 100])
def test_surplus_bytes_after_a_cdr_message_are_ignored(surplus: int) -> None:
    assert twists.decode("", AS_CDR + b"\xff" * surplus) == TWIST


def test_big_endian_cdr_is_decoded() -> None:
    swapped = b"\x00\x00\x00\x00" + struct.pack(">6d", 0.5, 0, 0, 0, 0, 0.2)
    assert twists.decode("", swapped) == TWIST
    assert twists.decode("application/cdr", swapped) == TWIST


def test_a_payload_in_another_format_than_its_named_encoding_is_refused() -> None:
    assert refusal("application/cdr", AS_JSON) == "malformed"
    assert refusal("application/cdr", encode(TWIST, "msgpack")) == "malformed"
    assert refusal("application/json", AS_CDR) == "malformed"
    assert refusal("application/msgpack", AS_CDR) in ("malformed", "wrong_shape")
    assert refusal("application/msgpack", AS_JSON) in ("malformed", "wrong_shape")
    assert refusal("application/json", encode(TWIST, "msgpack")) == "malformed"


@each("depth", [10, 1000, 100_000])
@each(
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


@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_deep_nesting_is_refused_even_if_any_value_is_accepted(form: Format) -> None:
    anything = Decoder(dict[str, object])
    deep = b'{"x":' * 50_000 if form == "json" else b"\x81\xa1x" * 50_000
    with pytest.raises(DecodeError) as caught:
        anything.decode("", deep)
    assert caught.value.reason == "malformed"


headed = st.builds(
    bytes.__add__, st.sampled_from([AS_CDR[:4], bytes(4)]), st.binary(min_size=40, max_size=80)
)


@pytest.mark.slow
@given(
    st.binary(max_size=80) | headed,
    st.sampled_from(["", "application/json", "application/msgpack", "application/cdr"]),
)
@settings(max_examples=400)
def test_any_bytes_give_a_message_or_a_decode_error(payload: bytes, encoding: str) -> None:
    try:
        result = twists.decode(encoding, payload)
    except DecodeError:
        return
    assert isinstance(result, Twist)


axis = st.floats(allow_nan=False, allow_infinity=False)
vector = st.builds(Vector3, axis, axis, axis)


@given(st.builds(Twist, vector, vector), st.sampled_from(FORMATS))
def test_every_finite_twist_is_decoded_exactly_as_it_was_encoded(
    twist: Twist, form: Format
) -> None:
    assert twists.decode("", encode(twist, form)) == twist


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b'{"linear": {"x": NaN}}', "line 1, column 18: JSON cannot contain NaN or infinity"),
        (
            b'{\n "linear": {"x": -Infinity}}',
            "line 2, column 18: JSON cannot contain NaN or infinity",
        ),
        (b'{"linear":\n}', "line 2, column 1: invalid character"),
    ],
)
def test_text_that_is_not_json_is_reported_with_its_line_and_column(
    payload: bytes, text: str
) -> None:
    with pytest.raises(DecodeError) as refused:
        Decoder(Twist).decode("application/json", payload)
    assert (refused.value.reason, str(refused.value)) == ("malformed", text)
