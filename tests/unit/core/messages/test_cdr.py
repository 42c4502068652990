"""Tests of CDR encoding: each rule of the format, and comparison with the library rosbags.

CDR allows any padding bytes. Both encoders write zeros, so the tests can compare whole payloads. A
separate test proves that the decoder ignores padding. Run the soak test with `pytest -m soak -s
core/messages/test_cdr.py`.
"""

from __future__ import annotations

import math
import random
import re
import struct
import time
import tracemalloc
from collections import Counter
from datetime import datetime
from typing import Annotated, Any, cast

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta, Struct
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.messages.schema import (
    Battery,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    Imu,
    JointState,
    KeyValue,
    Message,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    RobotState,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.ros.parameters import ListRequest, Names, SetRequest
from acsard.core.ros.shapes import Trigger
from tests.each import each

LITTLE, BIG = b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"

I32 = Annotated[int, Meta(extra={"cdr": "i"})]
U8 = Annotated[int, Meta(extra={"cdr": "B"})]
I64 = Annotated[int, Meta(extra={"cdr": "q"})]


class Empty(Struct, frozen=True):
    """A request without fields."""


STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(get_types_from_msg("bool success\nstring message", "std_srvs/msg/Trigger"))
STORE.register(get_types_from_msg("uint8 nothing", "std_srvs/msg/Request"))

ROS_NAMES: dict[type[Struct], str] = {
    Twist: "geometry_msgs/msg/Twist",
    TwistStamped: "geometry_msgs/msg/TwistStamped",
    Odometry: "nav_msgs/msg/Odometry",
    TFMessage: "tf2_msgs/msg/TFMessage",
    JointState: "sensor_msgs/msg/JointState",
    Imu: "sensor_msgs/msg/Imu",
    Battery: "sensor_msgs/msg/BatteryState",
    PoseStamped: "geometry_msgs/msg/PoseStamped",
    DiagnosticArray: "diagnostic_msgs/msg/DiagnosticArray",
    Trigger: "std_srvs/msg/Trigger",
}


def built(value: Any, name: str) -> Any:
    """Return a message of the class `name` of rosbags, built from rosbags' own list of fields."""
    fields = STORE.fielddefs[name][1]
    return STORE.types[name](**{f: built_field(getattr(value, f), desc) for f, desc in fields})


def built_field(value: Any, desc: Any) -> Any:
    import numpy as np

    kind, inner = desc
    if kind == Nodetype.NAME:
        return built(value, inner)
    if kind == Nodetype.BASE:
        return math.nan if value is None else value
    (item_kind, item), _ = inner
    if item_kind == Nodetype.NAME:
        return [built(element, item) for element in value]
    return value if item[0] == "string" else np.array(value, dtype=item[0])


def plain(value: Any) -> Any:
    """Return a message of rosbags as dicts and lists."""
    if hasattr(value, "__msgtype__"):
        fields = STORE.fielddefs[value.__msgtype__][1]
        return {name: plain(getattr(value, name)) for name, _ in fields}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(element) for element in value] if isinstance(value, list) else value


def oracle_bytes(message: Struct, little: bool = True) -> bytes:
    name = ROS_NAMES[type(message)]
    return bytes(STORE.serialize_cdr(built(message, name), name, little_endian=little))


def oracle_value(payload: bytes, cls: type[Message]) -> Message:
    value = plain(STORE.deserialize_cdr(payload, ROS_NAMES[cls]))
    return msgspec.convert(without_nan(value) if cls is Battery else value, cls)


def without_nan(value: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a message with null in place of NaN."""
    return {name: None if field != field else field for name, field in value.items()}


def encoded(message: Struct) -> bytes:
    return Cdr(type(message)).encode(message)


# golden bytes

HALF = "000000000000e03f"
QUARTER = "000000000000d03f"


def odometry(frame: str, child: str) -> Odometry:
    twist = Twist(Vector3(0.5, 0.1, 0.2), Vector3(0.3, 0.4, 0.25))
    pose = Pose(Vector3(1.0, 2.0, 3.0), Quaternion(0.1, 0.2, 0.3, 0.9))
    return Odometry(
        Header(Time(1_700_000_000, 123_456_789), frame),
        child,
        PoseWithCovariance(pose, [float(i) for i in range(36)]),
        TwistWithCovariance(twist, [float(-i) for i in range(36)]),
    )


@each(
    ("message", "golden"),
    [
        (Twist(Vector3(0.5), Vector3(z=0.25)), HALF + "00" * 32 + QUARTER),
        (Trigger(True, "ok"), "01000000 03000000 6f6b00"),
        (Trigger(False, ""), "00000000 01000000 00"),
        (Empty(), "00"),
        (TFMessage([]), "00000000"),
        (
            TwistStamped(
                Header(Time(-1, 999_999_999), "base_link"), Twist(Vector3(0.5), Vector3(z=0.25))
            ),
            "ffffffff ffc99a3b 0a000000 626173655f6c696e6b00 0000" + HALF + "00" * 32 + QUARTER,
        ),
        (
            JointState(Header(Time(1, 2), ""), ["a"], [0.5], [], [0.25]),
            "01000000 02000000 01000000 00 000000"
            "01000000 02000000 6100 0000"
            "01000000" + HALF + "00000000 01000000" + QUARTER,
        ),
        (
            DiagnosticArray(
                Header(), [DiagnosticStatus(2, "n", "me", "", [KeyValue("k", "v")])]
            ),
            "00000000 00000000 01000000 00 000000 01000000"
            "02 000000 02000000 6e00 0000 03000000 6d6500 00 01000000 00 000000"
            "01000000 02000000 6b00 0000 02000000 7600",
        ),
    ],
)  # fmt: skip
def test_a_message_has_the_expected_bytes(message: Struct, golden: str) -> None:
    assert encoded(message) == LITTLE + bytes.fromhex(golden)
    assert Cdr(type(message)).decode(LITTLE + bytes.fromhex(golden)) == message


@each(
    ("message", "size"),
    [
        (Twist(Vector3(), Vector3()), 52),
        (TwistStamped(Header(), Twist(Vector3(), Vector3())), 68),
        (TwistStamped(Header(Time(), "base_link"), Twist(Vector3(), Vector3())), 76),
        (odometry("odom", "base_link"), 724),
        (odometry("", ""), 708),
        (Trigger(True, "ok"), 15),
        (Empty(), 5),
    ],
)
def test_a_message_has_the_expected_size(message: Struct, size: int) -> None:
    assert len(encoded(message)) == size


@each("frame", range(10))
@each("child", range(10))
def test_the_size_of_odometry_follows_from_its_two_frame_names(frame: int, child: int) -> None:
    names = -(-(8 + 4 + frame + 1) // 4) * 4 + 4 + child + 1
    size = 4 + -(-names // 8) * 8 + 680
    assert len(encoded(odometry("f" * frame, "c" * child))) == size


# against the oracle, both ways

number = st.floats(allow_nan=False)
text = st.text(max_size=12) | st.sampled_from(
    ["", "odom", "base_link", "läuft – 99 %", "车轮", "🤖", "x" * 255, "y" * 5000, "a\0b"]
)
when = st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 999_999_999))
header = st.builds(Header, when, text)
vector = st.builds(Vector3, number, number, number)
quaternion = st.builds(Quaternion, number, number, number, number)
covariance = st.lists(number, min_size=36, max_size=36) | st.just([0.0] * 36)
twist = st.builds(Twist, vector, vector)
transform = st.builds(TransformStamped, header, text, st.builds(Transform, vector, quaternion))
status = st.builds(
    DiagnosticStatus,
    st.integers(0, 127),  # the oracle takes a `byte` for signed
    text,
    text,
    text,
    st.lists(st.builds(KeyValue, text, text), max_size=4),
)
numbers = st.lists(number, max_size=9)
float32 = st.floats(allow_nan=False, width=32)
maybe = float32 | st.none()
byte = st.integers(0, 255)
cells = st.lists(float32, max_size=9)

MESSAGES: dict[type[Any], st.SearchStrategy[Any]] = {
    Twist: twist,
    TwistStamped: st.builds(TwistStamped, header, twist),
    Odometry: st.builds(
        Odometry,
        header,
        text,
        st.builds(PoseWithCovariance, st.builds(Pose, vector, quaternion), covariance),
        st.builds(TwistWithCovariance, twist, covariance),
    ),
    TFMessage: st.builds(TFMessage, st.lists(transform, max_size=4)),
    JointState: st.builds(
        JointState, header, st.lists(text, max_size=5), numbers, numbers, numbers
    ),
    DiagnosticArray: st.builds(DiagnosticArray, header, st.lists(status, max_size=4)),
    Trigger: st.builds(Trigger, st.booleans(), text),
    Battery: st.builds(
        Battery, header, *[maybe] * 7, *[byte] * 3, st.booleans(), cells, cells, text, text
    ),
}

many = pytest.mark.parametrize("cls", MESSAGES, ids=lambda cls: cls.__name__)


@many
@given(st.data())
def test_an_encoded_message_is_byte_for_byte_that_of_ros(
    cls: type[Message], data: st.DataObject
) -> None:
    message = data.draw(MESSAGES[cls])
    assert encoded(message) == oracle_bytes(message)


@many
@given(st.data())
def test_ros_decodes_every_encoded_message(cls: type[Message], data: st.DataObject) -> None:
    message = data.draw(MESSAGES[cls])
    assert oracle_value(encoded(message), cls) == message


@many
@pytest.mark.parametrize("little", [True, False])
@given(st.data())
def test_messages_encoded_by_ros_are_decoded_in_both_byte_orders(
    cls: type[Message], little: bool, data: st.DataObject
) -> None:
    message = data.draw(MESSAGES[cls])
    assert Cdr(cls).decode(oracle_bytes(message, little)) == message


def test_a_request_without_fields_is_encoded_as_one_byte_like_in_ros() -> None:
    request = STORE.types["std_srvs/msg/Request"](nothing=0)
    assert bytes(STORE.serialize_cdr(request, "std_srvs/msg/Request")) == encoded(Empty())


@pytest.mark.parametrize("size", [4, 5, 8])
def test_a_request_without_fields_is_decoded_with_any_body_length(size: int) -> None:
    assert Cdr(Empty).decode((LITTLE + bytes(4))[:size]) == Empty()


@each("size", range(4))
def test_a_request_without_fields_needs_a_complete_header(size: int) -> None:
    with pytest.raises(CdrError):
        Cdr(Empty).decode(LITTLE[:size])


@each("count", [0, 1, 100, 1000])
def test_long_lists_are_encoded_like_in_ros(count: int) -> None:
    moved = Transform(Vector3(1.0), Quaternion())
    transforms = [
        TransformStamped(Header(Time(i), "f" * (i % 9)), "c", moved) for i in range(count)
    ]
    values = [KeyValue(str(i), "v" * (i % 7)) for i in range(count)]
    part = DiagnosticStatus(1, "n", "m", "h", values)
    for message in (TFMessage(transforms), DiagnosticArray(Header(), [part] * 3)):
        assert encoded(message) == oracle_bytes(message)
        assert Cdr(type(message)).decode(encoded(message)) == message


@each("level", [0, 127, 128, 255])
def test_a_level_is_one_unsigned_byte(level: int) -> None:
    message = DiagnosticArray(Header(), [DiagnosticStatus(level, "", "", "", [])])
    assert encoded(message)[24] == level
    assert Cdr(DiagnosticArray).decode(encoded(message)) == message


@pytest.mark.parametrize("length", [70_000, 1_000_000])
def test_a_very_long_text_is_encoded_like_in_ros(length: int) -> None:
    message = Trigger(True, "ä" * length)
    assert encoded(message) == oracle_bytes(message)
    assert Cdr(Trigger).decode(encoded(message)) == message


@each("value", [math.inf, -math.inf, -0.0, 5e-324, 1.7976931348623157e308])
def test_special_floats_are_decoded_and_encoded_bit_for_bit(value: float) -> None:
    message = Twist(Vector3(value), Vector3(z=value))
    result = Cdr(Twist).decode(oracle_bytes(message))
    assert struct.pack("<d", result.linear.x) == struct.pack("<d", value)
    assert encoded(result) == oracle_bytes(message)


def test_nan_is_decoded_as_nan_and_not_refused_by_the_decoder() -> None:
    payload = LITTLE + struct.pack("<6d", math.nan, 0, 0, 0, 0, 0)
    assert math.isnan(Cdr(Twist).decode(payload).linear.x)


# padding and alignment


class TextThenNumber(Struct, frozen=True):
    text: str
    number: float


class TextThenNumbers(Struct, frozen=True):
    text: str
    numbers: list[float]
    last: I32


@each("length", range(10))
@each("head", [LITTLE, BIG])
def test_a_number_after_a_text_of_any_length_is_aligned_to_its_size(
    length: int, head: bytes
) -> None:
    order = "<" if head == LITTLE else ">"
    raw = b"t" * length + b"\0"
    pad = -(4 + len(raw)) % 8
    payload = head + struct.pack(f"{order}I", len(raw)) + raw + b"\xaa" * pad
    payload += struct.pack(f"{order}d", 0.5)
    message = TextThenNumber("t" * length, 0.5)
    assert Cdr(TextThenNumber).decode(payload) == message
    if head == LITTLE:
        assert encoded(message) == payload.replace(b"\xaa", b"\0")


@each("length", range(10))
@each("count", range(3))
def test_a_sequence_after_a_text_of_any_length_is_padded_only_before_its_items(
    length: int, count: int
) -> None:
    raw = b"t" * length + b"\0"
    body = struct.pack("<I", len(raw)) + raw
    body += b"\xaa" * (-len(body) % 4) + struct.pack("<I", count)
    if count:
        body += b"\xaa" * (-len(body) % 8) + struct.pack("<d", 0.5) * count
    body += struct.pack("<i", -7)
    message = TextThenNumbers("t" * length, [0.5] * count, -7)
    assert Cdr(TextThenNumbers).decode(LITTLE + body) == message
    assert encoded(message) == LITTLE + body.replace(b"\xaa", b"\0")


@each("frame", range(10))
def test_padding_is_never_read(frame: int) -> None:
    message = odometry("f" * frame, "child")
    payload = bytearray(oracle_bytes(message))
    first = 4 + 12 + frame + 1
    second = first + -(first - 4) % 4
    third = second + 4 + 6
    for at in (*range(first, second), *range(third, third + -(third - 4) % 8)):
        assert payload[at] == 0
        payload[at] = 0xEE
    assert Cdr(Odometry).decode(bytes(payload)) == message


@each("surplus", [1, 3, 4, 7, 1000])
def test_bytes_after_the_message_are_ignored(surplus: int) -> None:
    for payload, message in valid():
        assert Cdr(type(message)).decode(payload + b"\xff" * surplus) == message


@pytest.mark.parametrize("options", [b"\x00\x00", b"\x00\x03", b"\xff\xff"])
def test_the_options_of_the_header_do_not_matter(options: bytes) -> None:
    for payload, message in valid():
        assert Cdr(type(message)).decode(payload[:2] + options + payload[4:]) == message


@each(
    "head",
    [b"", b"\0", b"\0\1", b"\0\1\0", b"\0\2\0\0", b"\0\3\0\0", b"\0\6\0\0", b"\0\7\0\0",
     b"\1\0\0\0", b"\1\1\0\0", b"\xff" * 4, b"{}\0\0"],
)  # fmt: skip
def test_an_unknown_header_is_refused(head: bytes) -> None:
    with pytest.raises(CdrError, match="header"):
        Cdr(Twist).decode(head + bytes(48) if len(head) == 4 else head)


# structs of any shape


class Mixed(Struct, frozen=True):
    small: U8
    flag: bool
    whole: I64
    real: float


class Inner(Struct, frozen=True):
    flag: bool
    mixed: Mixed
    name: str


class Outer(Struct, frozen=True):
    flags: list[bool]
    reals: list[float]
    texts: list[str]
    inners: list[Inner]
    pair: Annotated[list[float], Meta(min_length=2, max_length=2)]
    names: Annotated[list[str], Meta(min_length=2, max_length=2)]
    mixed: Mixed
    end: bool


MIXED = Mixed(200, True, -(2**63), 0.5)
OUTER = Outer(
    [True, False, True],
    [0.5],
    ["", "ä"],
    [Inner(True, MIXED, "x"), Inner(False, MIXED, "")],
    [0.5, -0.5],
    ["l", "right"],
    MIXED,
    True,
)


def test_a_run_of_numbers_is_aligned_field_by_field() -> None:
    golden = "c801 000000000000 0000000000000080" + HALF
    assert encoded(MIXED) == LITTLE + bytes.fromhex(golden)
    assert Cdr(Mixed).decode(LITTLE + bytes.fromhex(golden)) == MIXED


@each("length", range(9))
def test_a_run_of_numbers_is_aligned_at_any_start_position(length: int) -> None:
    class After(Struct, frozen=True):
        text: str
        mixed: Mixed
        last: bool

    body = struct.pack("<I", length + 1) + b"t" * length + b"\0" + b"\xc8\x01"
    body += bytes(-len(body) % 8) + struct.pack("<qd?", -(2**63), 0.5, True)
    message = After("t" * length, MIXED, True)
    assert encoded(message) == LITTLE + body
    assert Cdr(After).decode(LITTLE + body) == message


def test_sequences_and_arrays_of_structs_are_decoded_as_they_were_encoded() -> None:
    assert Cdr(Outer).decode(encoded(OUTER)) == OUTER


def test_sequences_arrays_and_structs_are_written_item_by_item_in_order() -> None:
    """Read the payload value by value with only the struct module."""
    payload = encoded(OUTER)
    at = 4

    def take(code: str) -> Any:
        nonlocal at
        size = struct.calcsize("<" + code)
        at += -(at - 4) % size
        (value,) = struct.unpack_from("<" + code, payload, at)
        at += size
        return value

    def take_text() -> str:
        nonlocal at
        length = take("I")
        at += length
        assert payload[at - 1] == 0
        return payload[at - length : at - 1].decode()

    def take_mixed() -> Mixed:
        return Mixed(take("B"), take("?"), take("q"), take("d"))

    assert [take("?") for _ in range(take("I"))] == OUTER.flags
    assert [take("d") for _ in range(take("I"))] == OUTER.reals
    assert [take_text() for _ in range(take("I"))] == OUTER.texts
    assert [Inner(take("?"), take_mixed(), take_text()) for _ in range(take("I"))] == OUTER.inners
    assert [take("d"), take("d")] == OUTER.pair
    assert [take_text(), take_text()] == OUTER.names
    assert take_mixed() == OUTER.mixed
    assert take("?") is OUTER.end
    assert at == len(payload)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_an_array_of_the_wrong_length_cannot_be_encoded(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count} items in an array of 2"):
        encoded(Outer([], [], [], [], [0.0] * count, ["", ""], MIXED, True))


class Wholes(Struct, frozen=True):
    longs: list[I64]
    bytes_: list[U8]
    four: Annotated[list[I32], Meta(min_length=4, max_length=4)]


def test_a_sequence_of_whole_numbers_is_packed_at_their_width() -> None:
    message = Wholes([-1, 2], [1, 2, 255], [1, -2, 3, -4])
    body = struct.pack("<I4x2qI3Bx4i", 2, -1, 2, 3, 1, 2, 255, 1, -2, 3, -4)
    assert encoded(message) == LITTLE + body
    assert Cdr(Wholes).decode(LITTLE + body) == message


class Flag(Struct, frozen=True):
    on: bool


class Flags(Struct, frozen=True):
    flags: list[Flag]


def test_a_sequence_of_one_byte_structs_is_decoded_as_it_was_encoded() -> None:
    for count in range(9):
        message = Flags([Flag(i % 2 == 0) for i in range(count)])
        assert Cdr(Flags).decode(encoded(message)) == message


class Rows(Struct, frozen=True):
    class Row(Struct, frozen=True):
        cells: list[float]
        names: list[str]

    rows: list[Row]


def test_nested_sequences_are_decoded_as_they_were_encoded() -> None:
    rows = [Rows.Row([0.5] * n, ["n"] * (3 - n)) for n in range(4)]
    assert Cdr(Rows).decode(encoded(Rows(rows))) == Rows(rows)


class MaybeText(Struct):
    field: str | None


class NumberOrText(Struct):
    field: float | str


class Map(Struct):
    field: dict[str, float]


class Raw(Struct):
    field: bytes


class Whole(Struct):
    field: int


class Moment(Struct):
    field: datetime


class Anything(Struct):
    field: Any


class ListOfMaps(Struct):
    field: list[dict[str, float]]


class ListOfLists(Struct):
    field: list[list[float]]


class ListOfWholes(Struct):
    field: list[int]


@each(
    "cls",
    [MaybeText, NumberOrText, Map, Raw, Whole, Moment, Anything, ListOfMaps, ListOfLists,
     ListOfWholes, RobotState, int, dict, str, list[float]],
)  # fmt: skip
def test_a_type_without_a_cdr_form_is_a_type_error(cls: Any) -> None:
    with pytest.raises(TypeError):
        Cdr(cls)


# refusals


def stamp(nanosec: int, order: str = "<") -> bytes:
    return (LITTLE if order == "<" else BIG) + struct.pack(f"{order}iI", 0, nanosec)


def test_a_time_with_a_billion_or_more_nanoseconds_is_refused() -> None:
    for order in "<>":
        assert Cdr(Time).decode(stamp(999_999_999, order)) == Time(0, 999_999_999)
        for bad in (1_000_000_000, 2**31, 2**32 - 1):
            with pytest.raises(CdrError, match=str(bad)):
                Cdr(Time).decode(stamp(bad, order))


@each("value", range(256))
def test_a_boolean_other_than_zero_or_one_is_refused(value: int) -> None:
    payload = LITTLE + bytes([value, 0, 0, 0]) + struct.pack("<I1s", 1, b"\0")
    if value < 2:
        assert Cdr(Trigger).decode(payload) == Trigger(bool(value), "")
        return
    with pytest.raises(CdrError):
        Cdr(Trigger).decode(payload)


@pytest.mark.parametrize("value", [2, 0xFF])
def test_a_boolean_other_than_zero_or_one_is_refused_in_a_sequence(value: int) -> None:
    payload = bytearray(encoded(OUTER))
    payload[9] = value
    with pytest.raises(CdrError):
        Cdr(Outer).decode(bytes(payload))


def reply_saying(length: int, raw: bytes) -> bytes:
    return LITTLE + struct.pack("<?3xI", True, length) + raw


@each(
    ("length", "raw"),
    [
        (1, b"a"),
        (2, b"ok"),
        (3, b"okk"),
        (2, b"\0k"),
        (2, b"\xff\0"),
        (3, b"\xc3\x28\0"),
        (4, b"\xed\xa0\x80\0"),
        (2, b"\xc3\0"),
        (5, b"\xf5\x80\x80\x80\0"),
        (3, b"\xc0\x80\0"),
    ],
)
def test_a_string_without_terminator_or_not_utf8_is_refused(length: int, raw: bytes) -> None:
    with pytest.raises(CdrError):
        Cdr(Trigger).decode(reply_saying(length, raw))


def test_a_string_of_length_zero_is_empty() -> None:
    assert Cdr(Trigger).decode(reply_saying(0, b"")) == Trigger(True, "")


@each("length", [2**32 - 1, 2**31, 2**31 - 1, 10**6, 4])
def test_a_string_longer_than_the_payload_is_refused(length: int) -> None:
    with pytest.raises(CdrError, match=str(length)):
        Cdr(Trigger).decode(reply_saying(length, b"ok\0"))


NO_ITEMS: list[tuple[Message, int]] = [
    (TFMessage([]), 0),
    *((JointState(), at) for at in (16, 20, 24, 28)),
    (DiagnosticArray(Header(), []), 16),
]
"""Empty messages, and the positions in their bodies of each sequence length."""


@each(("empty", "at"), NO_ITEMS)
@each("length", [2**32 - 1, 2**31, 2**29, 2**20, 1])
@each("surplus", [0, 3])
def test_a_sequence_longer_than_the_payload_is_refused_before_it_is_allocated(
    empty: Message, at: int, length: int, surplus: int
) -> None:
    payload = encoded(empty)[: 4 + at] + struct.pack("<I", length) + bytes(surplus)
    codec = Cdr(type(empty))
    tracemalloc.start()
    try:
        with pytest.raises(CdrError):
            codec.decode(payload)
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


class Numbers(Struct, frozen=True):
    """A struct with an unbounded list."""

    items: list[float] = []


def test_a_sequence_length_of_one_item_too_many_is_refused() -> None:
    message = JointState(Header(), ["a", "b"], [1.0, 2.0], [3.0], [])
    payload = encoded(message)
    at = payload.index(struct.pack("<d", 3.0)) - 8  # four bytes of padding lie in between
    assert payload[at : at + 8] == struct.pack("<II", 1, 0)
    longer = payload[:at] + struct.pack("<I", 2) + payload[at + 4 :]
    with pytest.raises(CdrError):
        Cdr(JointState).decode(longer)
    moved = TransformStamped(Header(), "c", Transform(Vector3(), Quaternion()))
    payload = encoded(TFMessage([moved, moved]))
    with pytest.raises(CdrError):
        Cdr(TFMessage).decode(payload[:4] + struct.pack("<I", 3) + payload[8:])


# limits on the number of items


class Node(Struct, frozen=True):
    name: str = ""


class Bounded(Struct, frozen=True):
    numbers: Annotated[list[float], Meta(max_length=3)] = []
    texts: Annotated[list[str], Meta(max_length=3)] = []
    nodes: Annotated[list[Node], Meta(max_length=3)] = []


@each("count", range(6))
@each("name", ["numbers", "texts", "nodes"])
def test_a_bounded_sequence_with_more_items_than_its_bound_is_refused(
    name: str, count: int
) -> None:
    item: dict[str, Any] = {"numbers": 0.5, "texts": "a", "nodes": Node("b")}
    fields: Any = {name: [item[name]] * count}
    message = Bounded(**fields)
    payload = encoded(message)
    if count <= 3:
        assert Cdr(Bounded).decode(payload) == message
        return
    with pytest.raises(CdrError, match=rf"^{count} items, but at most 3 are allowed$"):
        Cdr(Bounded).decode(payload)


@each("order", "<>")
@each(
    ("cls", "before", "most"),
    [
        (JointState, struct.pack("<iIIB3x", 0, 0, 1, 0), 64),
        (Names, b"", 256),
        (ListRequest, b"", 256),
        (SetRequest, b"", 128),
    ],
)
def test_too_many_items_are_refused_before_any_item_is_decoded(
    cls: type[Struct], before: bytes, most: int, order: str
) -> None:
    if order == ">" and before:
        before = struct.pack(">iIIB3x", 0, 0, 1, 0)
    head = (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + before
    count = (4096 - len(head) - 4) // 4
    for items in (bytes(4 * count), b"\xff" * 4 * count):  # the second body contains no valid item
        payload = head + struct.pack(order + "I", count) + items
        assert len(payload) == 4096
        with pytest.raises(CdrError, match=rf"^{count} items, but at most {most} are allowed$"):
            Cdr(cls).decode(payload)


@pytest.mark.parametrize(("cls", "most"), [(JointState, 64), (Names, 128), (ListRequest, 128)])
def test_the_largest_permitted_number_of_names_is_decoded(cls: type[Struct], most: int) -> None:
    made: dict[type[Struct], Struct] = {
        JointState: JointState(Header(), ["j"] * most, [0.5] * most, [0.5] * most, [0.5] * most),
        Names: Names(["n"] * most),
        ListRequest: ListRequest(["n"] * most, 0),
    }
    assert Cdr(cls).decode(encoded(made[cls])) == made[cls]


@each("field", ["name", "position", "velocity", "effort"])
def test_each_list_of_a_joint_state_is_bounded(field: str) -> None:
    items = ["j"] * 65 if field == "name" else [0.5] * 65
    payload = oracle_bytes(JointState(**cast(dict[str, Any], {field: items})))
    with pytest.raises(CdrError, match=r"65 items, but at most 64 are allowed"):
        Cdr(JointState).decode(payload)


@pytest.mark.slow
def test_decoding_many_sequence_lengths_keeps_no_memory_per_length() -> None:
    codec = Cdr(Numbers)
    payloads = [
        # This project's decoder would prepare `codec`.
        struct.pack(order, 0, flag, 0, 0, count, *[0.5] * count)
        for count in range(1, 501)
        for flag, order in ((1, f"<4BI4x{count}d"), (0, f">4BI4x{count}d"))
    ]
    codec.decode(payloads[0])
    tracemalloc.start()
    try:
        for payload in payloads:
            codec.decode(payload)
        assert tracemalloc.get_traced_memory()[0] < 200_000
    finally:
        tracemalloc.stop()


# damage


def samples() -> list[Any]:
    turned = Transform(Vector3(1.0, 2.0, 3.0), Quaternion(0.0, 0.0, 0.6, 0.8))
    speed = Twist(Vector3(0.5), Vector3(z=-0.25))
    now = Time(1_700_000_000, 123_456_789)
    return [
        speed,
        TwistStamped(Header(now, "base_link"), speed),
        odometry("odom", "base_link"),
        TFMessage([TransformStamped(Header(now, f), "base_link", turned) for f in ("odom", "m")]),
        JointState(Header(now, ""), ["fr", "fl", "rl", "rr"], [0.5] * 4, [1.5] * 4, []),
        DiagnosticArray(
            Header(now, ""),
            [
                DiagnosticStatus(1, "link", "läuft", "acsar", [KeyValue("rate", "99")] * 3),
                DiagnosticStatus(0, "", "", "", []),
            ],
        ),
        Trigger(True, "stopped"),
        Battery(Header(now, ""), 24.25, None, -1.5, percentage=0.875, present=True, location="a"),
    ]


def valid() -> list[tuple[bytes, Message]]:
    """Return each message in both byte orders."""
    return [
        (oracle_bytes(message, little), message)
        for message in samples()
        for little in (True, False)
    ]


def test_a_payload_that_is_truncated_at_any_position_is_refused() -> None:
    for payload, message in valid():
        codec = Cdr(type(message))
        for size in range(len(payload)):
            with pytest.raises(CdrError):
                codec.decode(payload[:size])
    for size in range(len(encoded(OUTER))):
        with pytest.raises(CdrError):
            Cdr(Outer).decode(encoded(OUTER)[:size])


def weight(value: object) -> int:
    """Return the total number of list items and characters in a message."""
    if isinstance(value, str):
        return len(value)
    if isinstance(value, list):
        return len(value) + sum(map(weight, value))
    if isinstance(value, Struct):
        return sum(weight(getattr(value, field)) for field in value.__struct_fields__)
    return 0


LENGTHS = (0, 1, 2, 5, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1)


def damaged(payload: bytes, dice: random.Random) -> bytes:
    """Return a valid payload with one to three random kinds of damage."""
    for _ in range(dice.randint(1, 3)):
        at = dice.randrange(len(payload) + 1)
        end = min(len(payload), at + dice.randint(0, 9))
        match dice.randrange(7):
            case 0 | 1 if payload:
                at %= len(payload)
                flipped = payload[at] ^ 1 << dice.randrange(8)
                payload = b"%b%c%b" % (payload[:at], flipped, payload[at + 1 :])
            case 2:
                payload = payload[:at]
            case 3:
                payload = payload[:at] + payload[end:]
            case 4:
                payload = payload[:at] + dice.randbytes(dice.randint(1, 9)) + payload[at:]
            case 5:
                payload = payload[:at] + dice.randbytes(end - at) + payload[end:]
            case _:  # overwrite a length, which lies at a multiple of four
                at -= at % 4
                order = dice.choice("<>")
                length = struct.pack(f"{order}I", dice.choice((*LENGTHS, dice.randrange(64))))
                payload = payload[:at] + length + payload[at + 4 :]
    return payload


@pytest.mark.slow
@pytest.mark.parametrize(
    "count",
    [20_000, pytest.param(1_000_000, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])],
)
def test_damaged_payloads_raise_only_cdr_errors_and_decode_to_no_more_than_their_size(
    count: int,
) -> None:
    dice, began, tally = random.Random(8), time.perf_counter(), Counter[str]()
    payloads = [(payload, cast(Cdr[Message], Cdr(type(message)))) for payload, message in valid()]
    for i in range(count):
        payload, codec = payloads[i % len(payloads)]
        data = damaged(payload, dice)
        try:
            result = codec.decode(data)
        except CdrError as error:
            words = re.split(":|, has", str(error))[0]
            tally[re.sub(r"-?\d+", "n", words)] += 1
            continue
        assert weight(result) <= len(data) + 72  # the two covariances have a fixed length
        again = codec.encode(result)
        assert codec.encode(codec.decode(again)) == again
        tally["accepted"] += 1
    took = time.perf_counter() - began
    print(f"\n{count} damaged payloads in {took:.0f} s, no exception but CdrError")
    for what, times in tally.most_common():
        print(f"  {times:8} {what}")
    assert count * 0.2 < tally["accepted"] < count * 0.8


@pytest.mark.slow
@given(st.binary(max_size=200), st.sampled_from([LITTLE, BIG, b""]), st.sampled_from(samples()))
@settings(max_examples=300)
def test_any_bytes_give_a_message_or_a_cdr_error(body: bytes, head: bytes, like: Message) -> None:
    try:
        result = Cdr(type(like)).decode(head + body)
    except CdrError:
        return
    assert isinstance(result, type(like))
