"""CDR against rosbags, the only oracle: every type both ways, in both byte orders; what is refused.

CDR allows any padding bytes. Both encoders write zeros, so whole payloads can be compared.
"""

from __future__ import annotations

import math
import struct
import tracemalloc
from datetime import datetime
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
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
    """Every kind of field, after fields of every length."""

    text: str
    flags: list[bool]
    wholes: list[I64]
    bytes_: list[U8]
    four: Annotated[list[I32], Meta(min_length=4, max_length=4)]
    texts: list[str]
    inners: list[Inner]
    pair: Annotated[list[float], Meta(min_length=2, max_length=2)]
    names: Annotated[list[str], Meta(min_length=2, max_length=2)]
    mixed: Mixed
    end: bool


class Empty(Struct, frozen=True):
    """In CDR, a message without fields takes one byte."""


STORE = get_typestore(Stores.ROS2_JAZZY)
for _definition, _name in (
    ("bool success\nstring message", "std_srvs/msg/Trigger"),
    ("uint8 small\nbool flag\nint64 whole\nfloat64 real", "test_msgs/msg/Mixed"),
    ("bool flag\ntest_msgs/Mixed mixed\nstring name", "test_msgs/msg/Inner"),
    ("string text\nbool[] flags\nint64[] wholes\nuint8[] bytes_\nint32[4] four\nstring[] texts\n"
     "test_msgs/Inner[] inners\nfloat64[2] pair\nstring[2] names\ntest_msgs/Mixed mixed\nbool end",
     "test_msgs/msg/Outer"),
):  # fmt: skip
    STORE.register(get_types_from_msg(_definition, _name))


def built(value: Any, desc: Any) -> Any:
    """Return a value for rosbags, from its own description of the type."""
    kind, inner = desc
    if kind == Nodetype.NAME:
        fields = STORE.fielddefs[inner][1]
        return STORE.types[inner](**{name: built(getattr(value, name), d) for name, d in fields})
    if kind == Nodetype.BASE:
        return math.nan if value is None else value
    (item_kind, item), _ = inner
    if item_kind == Nodetype.NAME or item[0] == "string":
        return [built(element, (item_kind, item)) for element in value]
    return np.array(value, dtype=item[0])


def by_ros(message: Struct, *, little: bool = True) -> bytes:
    name = ROS_NAMES[type(message)]
    message = built(message, (Nodetype.NAME, name))
    return bytes(STORE.serialize_cdr(message, name, little_endian=little))


def encoded(message: Struct) -> bytes:
    return Cdr(type(message)).encode(message)


number = st.floats(allow_nan=False)
text = st.text(max_size=12) | st.sampled_from(["läuft – 99 %", "车轮", "🤖", "y" * 5000, "a\0b"])
header = st.builds(
    Header, st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 999_999_999)), text
)
vector = st.builds(Vector3, number, number, number)
quaternion = st.builds(Quaternion, number, number, number, number)
pose, twist = st.builds(Pose, vector, quaternion), st.builds(Twist, vector, vector)
transform = st.builds(TransformStamped, header, text, st.builds(Transform, vector, quaternion))
mixed = st.builds(
    Mixed, st.integers(0, 255), st.booleans(), st.integers(-(2**63), 2**63 - 1), number
)


def numbers(least: int = 0, most: int = 9) -> Any:
    return st.lists(number, min_size=least, max_size=most)


nine, covariance = numbers(9, 9), st.builds(lambda a: (a * 4)[:36], numbers(9, 9))
level = st.integers(0, 127)  # rosbags takes a `byte` for signed
values = st.lists(st.builds(KeyValue, text, text), max_size=4)
status = st.builds(DiagnosticStatus, level, text, text, text, values)
float32 = st.floats(allow_nan=False, width=32)
cells, byte = st.lists(float32, max_size=9), st.integers(0, 255)

TYPES: dict[type[Any], tuple[str, Any]] = {
    Twist: ("geometry_msgs/msg/Twist", twist),
    TwistStamped: ("geometry_msgs/msg/TwistStamped", st.builds(TwistStamped, header, twist)),
    PoseStamped: ("geometry_msgs/msg/PoseStamped", st.builds(PoseStamped, header, pose)),
    Odometry: ("nav_msgs/msg/Odometry", st.builds(
        Odometry, header, text, st.builds(PoseWithCovariance, pose, covariance),
        st.builds(TwistWithCovariance, twist, covariance))),
    TFMessage: ("tf2_msgs/msg/TFMessage", st.builds(TFMessage, st.lists(transform, max_size=4))),
    JointState: ("sensor_msgs/msg/JointState", st.builds(
        JointState, header, st.lists(text, max_size=5), numbers(), numbers(), numbers())),
    Imu: ("sensor_msgs/msg/Imu", st.builds(
        Imu, header=header, orientation=quaternion, orientation_covariance=nine,
        angular_velocity=vector, angular_velocity_covariance=nine, linear_acceleration=vector,
        linear_acceleration_covariance=nine)),
    Battery: ("sensor_msgs/msg/BatteryState", st.builds(
        Battery, header, *[float32 | st.none()] * 7, *[byte] * 3, st.booleans(), cells, cells,
        text, text)),
    DiagnosticArray: ("diagnostic_msgs/msg/DiagnosticArray", st.builds(
        DiagnosticArray, header, st.lists(status, max_size=4))),
    Trigger: ("std_srvs/msg/Trigger", st.builds(Trigger, st.booleans(), text)),
    Outer: ("test_msgs/msg/Outer", st.builds(
        Outer, text, st.lists(st.booleans()), st.lists(st.integers(-(2**63), 2**63 - 1)),
        st.lists(byte), st.lists(st.integers(-(2**31), 2**31 - 1), min_size=4, max_size=4),
        st.lists(text, max_size=4), st.lists(st.builds(Inner, st.booleans(), mixed, text),
        max_size=3), numbers(2, 2), st.lists(text, min_size=2, max_size=2), mixed,
        st.booleans())),
}  # fmt: skip
ROS_NAMES = {cls: name for cls, (name, _) in TYPES.items()}


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
@given(st.data())
def test_a_message_is_written_as_ros_writes_it_and_read_in_both_byte_orders(
    cls: type[Any], data: st.DataObject
) -> None:
    message = data.draw(TYPES[cls][1])
    assert encoded(message) == by_ros(message)
    payload, codec = by_ros(message, little=data.draw(st.booleans())), Cdr(cls)
    assert codec.decode(payload) == message
    # Neither the options in the header nor bytes behind the message matter.
    assert codec.decode(payload[:2] + b"\xff\x03" + payload[4:] + data.draw(st.binary())) == message
    with pytest.raises(CdrError):
        codec.decode(payload[: data.draw(st.integers(0, len(payload) - 1))])


@given(st.lists(st.floats(), min_size=6, max_size=6))
def test_every_float_is_read_and_written_bit_for_bit(six: list[float]) -> None:
    payload = LITTLE + struct.pack("<6d", *six)
    assert encoded(Cdr(Twist).decode(payload)) == payload


def test_a_request_without_fields_is_one_byte_and_read_with_any_body() -> None:
    assert encoded(Empty()) == LITTLE + b"\0"
    for size in range(4, 9):
        assert Cdr(Empty).decode((LITTLE + bytes(4))[:size]) == Empty()
    with pytest.raises(CdrError):
        Cdr(Empty).decode(LITTLE[:3])


@pytest.mark.parametrize("count", [1, 3])
def test_an_array_of_the_wrong_length_cannot_be_written(count: int) -> None:
    outer = Outer("", [], [], [], [0] * 4, [], [], [0.5] * count, ["", ""],
                  Mixed(0, True, 0, 0.5), True)  # fmt: skip
    with pytest.raises(ValueError, match=f"{count} items in an array of 2"):
        encoded(outer)


def of(kind: Any) -> type[Struct]:
    return msgspec.defstruct("Of", [("field", kind)])


@each(
    "cls",
    [*map(of, (str | None, float | str, dict[str, float], bytes, int, datetime, Any,
               list[dict[str, float]], list[list[float]], list[int])),
     RobotState, int, dict, str, list[float]],
)  # fmt: skip
def test_a_type_without_a_cdr_form_is_a_type_error(cls: Any) -> None:
    with pytest.raises(TypeError):
        Cdr(cls)


# What is refused.


def reply(length: int, raw: bytes, success: int = 1) -> bytes:
    return LITTLE + struct.pack("<B3xI", success, length) + raw


def joints(**lists: Any) -> JointState:
    return JointState(**lists)


def items(cls: type[Struct], count: int, item: bytes, order: str = "<") -> bytes:
    """Return a payload with this number of items in the first sequence of a type."""
    head = struct.pack(f"{order}iIIB3x", 0, 0, 1, 0) if cls is JointState else b""
    body = head + struct.pack(f"{order}I", count) + item * count
    return (LITTLE if order == "<" else BIG) + body


REFUSED: list[tuple[type[Struct], bytes, str]] = [
    *((Twist, head + bytes(48), "must begin with the header") for head in (
        b"\0\2\0\0", b"\0\3\0\0", b"\0\6\0\0", b"\0\7\0\0", b"\1\0\0\0", b"\1\1\0\0", b"{}\0\0")),
    *((Twist, LITTLE[:size], "must begin with the header") for size in range(4)),
    *((Time, LITTLE + struct.pack("<iI", 0, nanoseconds), str(nanoseconds))
      for nanoseconds in (1_000_000_000, 2**32 - 1)),
    (Time, BIG + struct.pack(">iI", 0, 1_000_000_000), "1000000000"),
    *((Trigger, reply(1, b"\0", value), f"must be 0 or 1, not {value}") for value in (2, 255)),
    (Outer, LITTLE + struct.pack("<I1s3xI3B", 1, b"\0", 3, 1, 0, 2), "must be 0 or 1, not 2"),
    *((Trigger, reply(len(raw), raw), "a zero byte") for raw in (b"a", b"ok", b"\0k")),
    *((Trigger, reply(len(raw), raw), "not UTF-8") for raw in (
        b"\xff\0", b"\xc3\x28\0", b"\xed\xa0\x80\0", b"\xc3\0", b"\xf5\x80\x80\x80\0",
        b"\xc0\x80\0")),
    *((Trigger, reply(length, b"ok\0"), f"sequence of {length} items")
      for length in (4, 10**6, 2**31, 2**32 - 1)),
    # Too many items are refused before any of them is read.
    *((cls, items(cls, most + 1, item, order), f"{most + 1} items, but at most {most}")
      for cls, most in ((JointState, 64), (Names, 256), (ListRequest, 256), (SetRequest, 128))
      for item in (bytes(4), b"\xff" * 4) for order in "<>"),
    *((JointState, by_ros(joints(**{name: ["j"] * 65 if name == "name" else [0.5] * 65})),
       "65 items, but at most 64") for name in ("name", "position", "velocity", "effort")),
]  # fmt: skip


@each(("cls", "payload", "words"), REFUSED)
def test_a_wrong_payload_is_refused(cls: type[Any], payload: bytes, words: str) -> None:
    with pytest.raises(CdrError, match=words):
        Cdr(cls).decode(payload)


def test_the_limits_are_accepted() -> None:
    most: list[Any] = [
        JointState(Header(), ["j"] * 64, *[[0.5] * 64] * 3), Names(["n"] * 256),
        ListRequest(["n"] * 256, 0), Time(0, 999_999_999), Trigger(False, ""),
    ]  # fmt: skip
    for message in most:
        assert Cdr(type(message)).decode(encoded(message)) == message
    assert Cdr(Trigger).decode(reply(0, b"")) == Trigger(True, "")


LENGTHS = [(TFMessage([]), 0), *((JointState(), at) for at in (16, 20, 24, 28)),
           (DiagnosticArray(Header(), []), 16)]  # fmt: skip
"""Empty messages, and the positions in their bodies of each sequence length."""


@each(("empty", "at"), LENGTHS)
@each("length", [1, 2**20, 2**32 - 1])
def test_a_sequence_beyond_the_payload_is_refused_before_it_takes_memory(
    empty: Any, at: int, length: int
) -> None:
    payload, codec = encoded(empty)[: 4 + at] + struct.pack("<I", length), Cdr(type(empty))
    tracemalloc.start()
    try:
        with pytest.raises(CdrError):
            codec.decode(payload)
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


damage = st.tuples(st.integers(0, 300), st.integers(0, 9), st.binary(max_size=9))


@given(
    st.one_of([strategy for _, strategy in TYPES.values()]),
    st.booleans(),
    st.lists(damage, min_size=1, max_size=3),
)
def test_a_damaged_payload_gives_a_message_or_a_cdr_error(
    message: Any, little: bool, damages: list[tuple[int, int, bytes]]
) -> None:
    payload, codec = by_ros(message, little=little), Cdr[Any](type(message))
    for at, lost, more in damages:
        payload = payload[:at] + more + payload[at + lost :]
    try:
        result = codec.decode(payload)
    except CdrError:
        return
    again = codec.encode(result)
    assert codec.encode(codec.decode(again)) == again
