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

from acsard.core.config.settings import Config, JointsConfig, OdometryConfig
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
    SwitchOff,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.values import (
    NS_PER_S,
    Estimate,
    Instant,
    Pose,
    PoseCovariance,
    TwistVariances,
    WheelSpeeds,
)
from acsard.core.values import Twist as PlainTwist
from tests.each import each
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, due

TWIST = Twist(Vector3(0.5), Vector3(z=0.2))
AS_CDR = b"\x00\x01\x00\x00" + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0.2)
AS_JSON = b'{"linear":{"x":0.5,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":0.2}}'
AS_MSGPACK = msgspec.msgpack.encode(msgspec.json.decode(AS_JSON))
JSON, MSGPACK, CDR = "application/json", "application/msgpack", "application/cdr"


def test_a_message_is_maps_in_json_and_msgpack_and_plain_cdr() -> None:
    assert encode(TWIST, "json") == AS_JSON
    assert encode(TWIST, "msgpack") == AS_MSGPACK
    assert encode(TWIST, "cdr") == AS_CDR
    names = [encoding_name(form, "Odometry") for form in FORMATS] + [encoding_name("json")]
    assert set(names) == {f"{e};acsard.Odometry.v1" for e in (JSON, MSGPACK, CDR)} | {JSON}


# what the daemon refuses and a client ignores


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
due(REPORT, OUTPUTS, {"state"}, lambda: SNAPSHOT)
MESSAGES = [
    *(REPORT.current(key, lambda: SNAPSHOT) for key in ("odom", "tf", "state", "diagnostics")),
    ServiceReply(True, "done", ReplyData([7], {"rates.odom": Change(1.0, 2.0)})),
    TwistStamped(Header(Time(1, 2), "odom"), TWIST), JointState(name=["a"], velocity=[1.0]),
    Release([7]), SwitchOff(True), SetPose(1.0, 2.0, 3.0), Settings({"rates.odom": 5.0}),
]  # fmt: skip


@each("message", MESSAGES)
@each("form", ["json", "msgpack"])
def test_a_client_ignores_unknown_fields_the_daemon_refuses(message: Message, form: Format) -> None:
    plain, more, kind = encode(message, form), encode(grown(message), form), type(message)
    assert Decoder(kind).decode("", more) == message
    received = StrictDecoder(kind).decode("", plain)
    assert isinstance(received, kind)
    assert msgspec.to_builtins(received) == msgspec.to_builtins(message)
    with pytest.raises(DecodeError, match="unknown field `later`"):
        StrictDecoder(kind).decode("", more)


@each(
    "value",
    [
        {"x": 0.5}, [0.5], 0.5, None,
        Info("r7", "1.2.3", 42, "/dev/x", True, 100.0, [], []),
        RobotState(Time(), "", "", 0, 0, 0, 0, 0, [], "", "", [], "", {}),
    ],
)  # fmt: skip
def test_a_type_that_is_not_a_ros_message_has_no_cdr(value: object) -> None:
    with pytest.raises(DecodeError, match=f"{type(value).__name__} is not a ROS message") as caught:
        encode(value, "cdr")
    assert caught.value.reason == "unknown_format"
    for encoding in ("", CDR):
        with pytest.raises(DecodeError) as caught:
            Decoder(type(value)).decode(encoding, AS_CDR)
        assert caught.value.reason == "unknown_format"


# the format of a payload

DETECTED: list[tuple[str, bytes, str]] = [
    *((name, payload, form)
      for name, form in ((JSON, "json"), (f"{JSON};acsard.Twist.v1", "json"), ("text/json", "json"),
                         (MSGPACK, "msgpack"), (f"{MSGPACK};whatever", "msgpack"), (CDR, "cdr"),
                         (f"{CDR};acsard.Twist.v1", "cdr"))
      for payload in (AS_JSON, AS_MSGPACK, AS_CDR, b"", b"\xff")),
    *((name, payload, form) for name in ("", "zenoh/bytes", "text/plain", "zenoh/string", "x")
      for form, payloads in {
          "json": (b"{}", b" \t\r\n{"),
          "msgpack": (b"\x80", b"\x82\xa1", b"\x8f", b"\xde\x00\x10", b"\xdf\x00\x00\x00\x10"),
          "cdr": (b"\x00\x00", b"\x00\x01", b"\x00\x01\x00\x03", b"\x00\x01\xff\xff{}"),
      }.items() for payload in payloads),
]  # fmt: skip


@each(("encoding", "payload", "form"), DETECTED)
def test_the_named_encoding_or_else_the_first_bytes_determine_the_format(
    encoding: str, payload: bytes, form: str
) -> None:
    assert detect(encoding, payload) == form


REFUSED: dict[str, dict[str, list[bytes]]] = {
    "": {
        "unknown_encoding": [
            b"", b"   ", b"[1]", b'"stop"', b"1", b"null", b"\x90", b"\x93\x01", b"\x7f", b"\xa1x",
            b"\xc0", b"\xdc\x00\x00", b"\xdd", b"\x00", b"\x00\x02\x00\x00", b"\x00\x03\x00\x00",
            b"\x01\x00\x00\x00", b"\x00\x07\x00\x00", b"\n\x00\x01", b"\xef\xbb\xbf{}",
        ],
    },
    JSON: {
        "wrong_shape": [
            b'{"linear":{}}', b'{"angular":{},"linear":{},"x":1}',
            b'{"linear":{"X":1},"angular":{}}', b'{"linear":{"x":"1"},"angular":{}}',
            b'{"linear":null,"angular":{}}', b'{"linear":[0.5,0,0],"angular":{}}',
            b'{"linear":{"x":1e999},"angular":{}}',
        ],
        "malformed": [
            b'{"linear":{"x":NaN},"angular":{}}', b'{"linear":{"x":Infinity},"angular":{}}',
            b'{"linear":{},"angular":{}', b'{"linear":{},"angular":{}} x',
            b'{"linear":{},"angular":{},"\xff":1}', b"{", AS_CDR, AS_MSGPACK,
        ],
    },
    MSGPACK: {
        "wrong_shape": [
            b"\x80", b"\x81\xa6linear\x80", b"\x82\xa6linear\x80\xa7angular\xc0",
            b"\x82\xa6linear\x81\xa1x\xa11\xa7angular\x80", b"\x82\x01\x80\x02\x80",
        ],
        "malformed": [
            b"\x82\xa6linear\x80", b"\x82\xa6linear\x80\xa7angular\x80\x00",
            b"\xdf\xff\xff\xff\xff",
            b"\x81\xdb\xff\xff\xff\xff", b"\x82\xa1\xff\x80\xa7angular\x80", b"\xc1",
        ],
    },
    CDR: {
        "malformed": [
            b"", b"\x00\x01", b"\x00\x01\x00", b"\x00\x01\x00\x00", b"\x00\x02" + AS_CDR[2:],
            b"\x00\x03" + AS_CDR[2:], AS_CDR[4:], AS_CDR[:-1], AS_CDR[:-8], AS_JSON, AS_MSGPACK,
        ],
    },
}  # fmt: skip


@each(
    ("encoding", "reason", "payload"),
    [(name, reason, payload) for name, reasons in REFUSED.items()
     for reason, payloads in reasons.items() for payload in payloads],
)  # fmt: skip
def test_a_payload_that_is_not_the_message_is_refused_with_its_reason(
    encoding: str, reason: str, payload: bytes
) -> None:
    with pytest.raises(DecodeError) as caught:
        StrictDecoder(Twist).decode(encoding, payload)
    assert caught.value.reason == reason


@each(
    ("payload", "text"),
    [
        (b'{"linear": {"x": NaN}}', "line 1, column 18: JSON cannot contain NaN or infinity"),
        (b'{\n "linear": {"x": -Infinity}}',
         "line 2, column 18: JSON cannot contain NaN or infinity"),
        (b'{"linear":\n}', "line 2, column 1: invalid character"),
    ],
)  # fmt: skip
def test_text_that_is_no_json_has_its_line_and_column(payload: bytes, text: str) -> None:
    with pytest.raises(DecodeError) as refused:
        Decoder(Twist).decode(JSON, payload)
    assert (refused.value.reason, str(refused.value)) == ("malformed", text)


# laws

headed = st.builds(
    bytes.__add__, st.sampled_from([AS_CDR[:4], bytes(4)]), st.binary(min_size=40, max_size=80)
)


@pytest.mark.slow
@given(st.binary(max_size=80) | headed, st.sampled_from(["", JSON, MSGPACK, CDR]))
@settings(max_examples=400)
def test_any_bytes_give_a_message_or_a_decode_error(payload: bytes, encoding: str) -> None:
    try:
        result = Decoder(Twist).decode(encoding, payload)
    except DecodeError:
        return
    assert isinstance(result, Twist)


axis = st.floats(allow_nan=False, allow_infinity=False)
vector = st.builds(Vector3, axis, axis, axis)


@given(st.builds(Twist, vector, vector), st.sampled_from(FORMATS), st.booleans())
def test_every_finite_twist_is_decoded_as_encoded(twist: Twist, form: Format, named: bool) -> None:
    encoding = encoding_name(form, "Twist") if named else ""
    assert Decoder(Twist).decode(encoding, encode(twist, form)) == twist


# frames, which are prepared for the messages of each line

any_float = st.floats()
wall_ns = st.one_of(
    st.integers(1_600_000_000 * NS_PER_S, (1 << 31) * NS_PER_S - 1),
    # Values that msgpack encodes in fewer bytes, or that do not fit the field `sec`.
    st.builds(
        lambda sec, nanosec: sec * NS_PER_S + nanosec,
        st.one_of(st.integers(-10, 1 << 17), st.integers((1 << 31) - 2, (1 << 32) + 2)),
        st.integers(0, 1 << 17),
    ),
)


def some(count: int, kind: Any = tuple) -> Any:
    return st.tuples(*[any_float] * count).map(lambda of: of if kind is tuple else kind(*of))


estimates = st.builds(
    Estimate, st.builds(Instant, st.just(0), wall_ns),
    st.builds(Pose, any_float, any_float, st.floats(-4.0, 4.0)), some(2, PlainTwist),
    some(6, PoseCovariance), some(3, TwistVariances), some(4), some(4, WheelSpeeds),
)  # fmt: skip


@pytest.mark.parametrize("form", FORMATS)
@given(several=st.lists(estimates, min_size=1, max_size=5))
def test_a_frame_equals_the_encoders_output(form: Format, several: list[Estimate]) -> None:
    config = Config(
        odometry=OdometryConfig(odom_frame="map/odom", base_frame="base", publish_tf=True),
        joints=JointsConfig(front_right="a rather long name of a joint"),
    )
    report = Report(config, Instant(0, 0))
    for estimate in several:
        for topic in report._feedback:
            assert topic.encode(estimate, form) == encode(topic.build(estimate), form)
