"""A message from the bus becomes a command or is refused; the only error is `DecodeError`.

The command names its sender. The sender is bound to a certificate.
"""

from __future__ import annotations

import math
import random
import struct
from itertools import product
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import CommandsConfig, DriveConfig, JointsConfig
from acsard.core.incoming.commands import (
    BINDING_NS,
    MAX_BINDINGS,
    Arrival,
    Bindings,
    Receiver,
    caller_name,
    claimed_identity,
)
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode
from acsard.core.messages.refusals import MAX_COMMAND_BYTES
from acsard.core.messages.schema import JointState, TwistStamped
from acsard.core.messages.schema import Twist as TwistMessage
from acsard.core.messages.signature import HASH_DIGITS, MAX_NAME_LENGTH, public_name
from acsard.core.motion.arbiter import Arbiter
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.attachments import Attachment
from acsard.core.values import Command, Echo, Pose, Request, Twist, Verb, WheelSpeeds
from tests.each import each

KINEMATICS = Kinematics(DriveConfig())
RECEIVER = Receiver(JointsConfig(), KINEMATICS)
JOINTS = list(JointsConfig().as_tuple())

ARRIVED_NS = 77_000_000_000
AXES = [("linear", "x"), ("linear", "y"), ("linear", "z"),
        ("angular", "x"), ("angular", "y"), ("angular", "z")]  # fmt: skip
HEADER_S = "native/app, header on native/cmd/app"
"""Name of the clock behind a header stamp when nothing else identifies the sender."""

NOT_FINITE = [math.nan, math.inf, -math.inf]


def arrival(payload: bytes, key: str = "cmd/app", **changes: Any) -> Arrival:
    fields: dict[str, Any] = {"put": True, "encoding": "", "stamp_ns": None, "sender": ""} | changes
    return Arrival(key=key, payload=payload, arrived_ns=ARRIVED_NS, **fields)


def written(body: dict[str, Any], form: Format) -> bytes:
    """Encode the fields of a command in this format.

    CDR carries no field names, so the function first converts the fields to their message type.
    """
    if form != "cdr":
        return encode(body, form)
    cls = TwistStamped if "twist" in body else JointState if "name" in body else TwistMessage
    return encode(msgspec.convert(body, cls), form)


def command(body: dict[str, Any], form: Format = "msgpack", **changes: Any) -> Command:
    return RECEIVER.command(arrival(written(body, form), **changes))


def wheels(body: dict[str, Any], form: Format = "msgpack", **changes: Any) -> Command:
    return command(body, form, key="wheel_cmd/app", **changes)


def refusal(incoming: Arrival) -> str:
    with pytest.raises(DecodeError) as caught:
        RECEIVER.command(incoming)
    return caught.value.reason


def refused(body: object, **changes: Any) -> str:
    return refusal(arrival(msgspec.msgpack.encode(body), **changes))


def twist(linear: float = 0.5, angular: float = 0.2) -> dict[str, Any]:
    return {"linear": {"x": linear}, "angular": {"z": angular}}


def stamped(sec: int, nanosec: int = 0) -> dict[str, Any]:
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}}, "twist": twist()}


def joints(*velocity: float, names: list[str] | None = None) -> dict[str, Any]:
    return {"name": names or JOINTS, "velocity": list(velocity)}


# samples that are commands


@pytest.mark.parametrize("form", FORMATS)
def test_a_twist_is_a_command_of_the_source_in_its_key(form: Format) -> None:
    assert command(twist(), form) == Command(
        "app", Twist(0.5, 0.2), ARRIVED_NS, None, "native/app", "native/app", shared=True
    )


@pytest.mark.parametrize("form", FORMATS)
def test_a_stamped_twist_is_the_same_command_with_a_stamp(form: Format) -> None:
    body = {
        "header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "base_link"},
        "twist": twist(),
    }
    assert command(body, form) == Command(
        "app", Twist(0.5, 0.2), ARRIVED_NS, 3_000_000_004, HEADER_S, "native/app", shared=True
    )


@pytest.mark.parametrize("form", FORMATS)
def test_a_command_with_a_named_encoding_is_decoded(form: Format) -> None:
    name = f"application/{form};acsard.Twist.v1"
    assert command(twist(), form, encoding=name).twist == Twist(0.5, 0.2)


def test_axes_default_to_zero() -> None:
    assert command({"linear": {}, "angular": {}}).twist == Twist(0.0, 0.0)
    assert command({"linear": {"x": -1.5}, "angular": {}}).twist == Twist(-1.5, 0.0)


def test_axes_a_planar_base_cannot_follow_are_ignored() -> None:
    body = {"linear": {"x": 1, "y": 2, "z": 3}, "angular": {"x": 4, "y": 5, "z": 6}}
    assert command(body).twist == Twist(1.0, 6.0)


@pytest.mark.parametrize("missing", ["linear", "angular"])
def test_both_parts_of_a_twist_are_required(missing: str) -> None:
    body = twist()
    del body[missing]
    assert refused(body) == "wrong_shape"
    assert refused({"header": {}, "twist": body}) == "wrong_shape"


@each(
    "body",
    [
        {},
        {"header": {}},
        {"twist": {}},
        {"x": 1.0},
        twist() | {"gain": 1},
        {"linear": {"x": 1, "X": 2}, "angular": {}},
        {"linear": {"x": "1"}, "angular": {}},
        {"linear": {"x": None}, "angular": {}},
        {"linear": 1.0, "angular": 1.0},
        {"linear": [1, 0, 0], "angular": [0, 0, 0]},
        {"twist": twist(), "linear": {"x": 1}},
        {"twist": twist(), "linear": {"x": 1}, "angular": {}},
        {"twist": twist(), "header": {"stamp": 5}},
        {"twist": twist(), "header": {"seq": 1}},
        {"twist": {"twist": twist()}},
    ],
)
def test_a_command_of_any_other_shape_is_refused(body: object) -> None:
    assert refused(body) == "wrong_shape"


@each("bad", NOT_FINITE)
@each(("part", "axis"), AXES)
def test_one_axis_that_is_not_finite_refuses_the_whole_command(
    part: str, axis: str, bad: float
) -> None:
    body = twist()
    body[part][axis] = bad
    assert refused(body) == "not_finite"
    assert refused({"header": {}, "twist": body}) == "not_finite"


# wheels


@pytest.mark.parametrize("form", FORMATS)
def test_wheel_speeds_are_converted_to_a_twist(form: Format) -> None:
    result = wheels(joints(4.0, 2.0, 2.0, 4.0), form).twist
    assert result.linear == pytest.approx(0.05 * 3.0)
    assert result.angular == pytest.approx(0.05 * 2.0 / 0.30)


def test_wheels_are_found_by_their_names_in_any_order() -> None:
    ordered = wheels(joints(1.0, 2.0, 4.0, 8.0)).twist
    mixed = joints(4.0, 1.0, 8.0, 2.0, names=[JOINTS[2], JOINTS[0], JOINTS[3], JOINTS[1]])
    assert wheels(mixed).twist == ordered


def test_wheels_that_differ_on_one_side_give_the_mean_of_the_side() -> None:
    assert wheels(joints(5.0, 1.0, 3.0, 3.0)).twist == wheels(joints(4.0, 2.0, 2.0, 4.0)).twist


def test_wheel_commands_use_the_configured_joint_names() -> None:
    receiver = Receiver(JointsConfig("fr", "fl", "rl", "rr"), KINEMATICS)
    body = joints(1.0, 1.0, 1.0, 1.0, names=["rl", "fr", "rr", "fl"])
    result = receiver.command(arrival(msgspec.msgpack.encode(body), key="wheel_cmd/app"))
    assert result.twist.linear == pytest.approx(0.05)
    assert refused(body, key="wheel_cmd/app") == "wrong_wheels"


@each(
    "body",
    [
        {},
        joints(),
        joints(1.0, 2.0, 3.0),
        joints(1.0, 2.0, 3.0, 4.0, 5.0),
        joints(1.0, 2.0, 3.0, names=JOINTS[:3]),
        joints(1.0, 2.0, 3.0, 4.0, names=[*JOINTS[:3], JOINTS[0]]),
        joints(1.0, 2.0, 3.0, 4.0, names=[*JOINTS[:3], "arm"]),
        joints(1.0, 2.0, 3.0, 4.0, names=[*JOINTS, JOINTS[0]]),
        joints(1.0, 2.0, 3.0, 4.0, names=[*JOINTS, "arm"]),
        joints(1.0, 2.0, 3.0, 4.0, 5.0, names=[*JOINTS[:3], "arm", "hand"]),
        joints(1.0, 2.0, 3.0, 4.0, 5.0, names=[*JOINTS, JOINTS[0]]),
        {"velocity": [1.0, 2.0, 3.0, 4.0]},
        {"name": JOINTS, "position": [1.0, 2.0, 3.0, 4.0]},
    ],
)
def test_a_wheel_command_without_exactly_the_four_wheels_is_refused(body: object) -> None:
    assert refused(body, key="wheel_cmd/app") == "wrong_wheels"


@each("form", FORMATS)
@each("place", range(5))
def test_the_joints_of_an_arm_among_the_wheels_are_ignored(form: Format, place: int) -> None:
    names, speeds = list(JOINTS), [1.0, 2.0, 4.0, 8.0]
    names.insert(place, "arm")
    for arm in (0.0, 1e308, *(NOT_FINITE if form != "json" else ())):
        velocity = [*speeds[:place], arm, *speeds[place:]]
        others = {"position": [0.5] * 5, "effort": [0.0] * place + [arm] + [0.0] * (4 - place)}
        body = joints(*velocity, names=names) | others
        assert wheels(body, form).twist == wheels(joints(*speeds)).twist


def test_the_speed_of_an_arm_does_not_count_as_a_wheel_speed() -> None:
    result = wheels(joints(0.0, 0.0, 0.0, 0.0, 3.0, names=[*JOINTS, "arm"]))
    assert (result.twist, result.cancelled) == (Twist(), False)


@each("bad", NOT_FINITE)
@each("place", range(4))
def test_one_wheel_that_is_not_finite_refuses_all_four(place: int, bad: float) -> None:
    velocity = [1.0] * 4
    velocity[place] = bad
    assert refused(joints(*velocity), key="wheel_cmd/app") == "not_finite"


@pytest.mark.parametrize("unused", ["position", "effort"])
def test_a_number_that_is_not_finite_in_an_unused_field_refuses_the_command(unused: str) -> None:
    body = joints(1.0, 1.0, 1.0, 1.0) | {unused: [0.0, math.nan]}
    assert refused(body, key="wheel_cmd/app") == "not_finite"


def test_wheel_speeds_that_overflow_are_refused() -> None:
    assert refused(joints(1e308, 1e308, 1e308, 1e308), key="wheel_cmd/app") == "not_finite"
    assert refused(joints(1e308, -1e308, -1e308, 1e308), key="wheel_cmd/app") == "not_finite"


def test_a_twist_on_a_wheel_key_and_wheels_on_a_twist_key_are_refused() -> None:
    assert refused(twist(), key="wheel_cmd/app") == "wrong_shape"
    assert refused(joints(1.0, 1.0, 1.0, 1.0), key="cmd/app") == "wrong_shape"


# wheel speeds that cancel each other


@each("form", FORMATS)
@each(
    ("speeds", "cancelled"),
    [
        ((0.0, 0.0, 0.0, 0.0), False),
        ((-0.0, 0.0, -0.0, 0.0), False),
        ((5.0, 5.0, -5.0, -5.0), True),  # front against rear wheels
        ((5.0, 0.0, 0.0, -5.0), True),  # the right wheels against each other
        ((5.0, 5.0, 5.0, 5.0), False),
        ((5.0, -5.0, -5.0, 5.0), False),
    ],
)
def test_wheel_speeds_that_cancel_out_are_marked_and_do_not_count_as_neutral(
    form: Format, speeds: tuple[float, ...], cancelled: bool
) -> None:
    result = wheels(joints(*speeds), form)
    assert result.cancelled is cancelled
    assert (result.twist == Twist(0.0, 0.0)) is (cancelled or not any(speeds))


@each("form", FORMATS)
@each(("part", "axis"), AXES)
def test_a_twist_on_axes_that_the_base_cannot_follow_does_not_count_as_neutral(
    form: Format, part: str, axis: str
) -> None:
    body = twist(0.0, 0.0)
    body[part][axis] = 0.5
    for message in (body, {"header": {}, "twist": body}):
        result = command(message, form)
        assert result.cancelled is (result.twist == Twist(0.0, 0.0))
    assert not command(twist(0.0, 0.0), form).cancelled


# payloads as ROS 2 itself writes them

ORDERS = [b"\x00\x00\x00\x00", b"\x00\x01\x00\x00"]
"""Headers of CDR: big endian and little endian."""


def cdr(header: bytes, layout: str, *values: object) -> bytes:
    return header + struct.pack((">" if header == ORDERS[0] else "<") + layout, *values)


def native_twist(header: bytes = ORDERS[1], linear: float = 0.5, angular: float = 0.2) -> bytes:
    return cdr(header, "6d", linear, 0, 0, 0, 0, angular)


def native_stamped(header: bytes, frame: bytes, sec: int = 3, nanosec: int = 4) -> bytes:
    pad = -(12 + len(frame) + 1) % 8
    layout = f"iII{len(frame) + 1}s{pad}x6d"
    return cdr(header, layout, sec, nanosec, len(frame) + 1, frame, 0.5, 0, 0, 0, 0, 0.2)


def native_joints(header: bytes, velocity: list[float]) -> bytes:
    names = b""
    for joint in JOINTS:
        names += bytes(-len(names) % 4)
        names += cdr(header, f"I{len(joint) + 1}s", len(joint) + 1, joint.encode())[4:]
    body = cdr(header, "iIIB3xI", 0, 0, 1, 0, len(JOINTS)) + names + bytes(-len(names) % 4)
    body += cdr(header, "II", 0, len(velocity))[4:]
    body += bytes(-(len(body) - 4) % 8)
    return body + cdr(header, f"{len(velocity)}dI", *velocity, 0)[4:]


@each("header", ORDERS)
@each("encoding", ["", "zenoh/bytes", "application/cdr"])
def test_a_native_twist_of_52_bytes_is_a_command(header: bytes, encoding: str) -> None:
    payload = native_twist(header)
    assert len(payload) == 52
    result = RECEIVER.command(arrival(payload, encoding=encoding, stamp_ns=5))
    plain = Command("app", Twist(0.5, 0.2), ARRIVED_NS, 5, "native/app", "native/app", shared=True)
    assert result == plain


@each("header", ORDERS)
@each(("frame", "size"), [(b"", 68), (b"base_link", 76)])
def test_a_native_stamped_twist_is_a_command_with_its_stamp(
    header: bytes, frame: bytes, size: int
) -> None:
    payload = native_stamped(header, frame)
    assert len(payload) == size
    result = RECEIVER.command(arrival(payload, stamp_ns=5))
    assert (result.twist, result.stamp_ns, result.clock) == (
        Twist(0.5, 0.2),
        3_000_000_004,
        HEADER_S,
    )


@each("frame", [b"f" * n for n in (1, 2, 3, 4, 8, 16, 200)])
def test_a_native_stamped_twist_may_have_any_frame(frame: bytes) -> None:
    assert RECEIVER.command(arrival(native_stamped(ORDERS[1], frame))).twist == Twist(0.5, 0.2)


@each("surplus", range(4))
@each("fill", [b"\x00", b"\xff"])
def test_the_padding_of_dds_does_not_change_the_command(surplus: int, fill: bytes) -> None:
    more = fill * surplus
    assert RECEIVER.command(arrival(native_twist() + more)).twist == Twist(0.5, 0.2)
    for frame in (b"", b"base_link"):
        result = RECEIVER.command(arrival(native_stamped(ORDERS[1], frame) + more))
        assert (result.twist, result.stamp_ns) == (Twist(0.5, 0.2), 3_000_000_004)


TOLD = {
    "Twist": "application/cdr;geometry_msgs/msg/Twist",
    "TwistStamped": "application/cdr;geometry_msgs/msg/TwistStamped",
}
"""Encodings that an rmw key states for its payload."""


@each("surplus", [*range(9), 16, 24, 200])
@each("fill", [b"\x00", b"\xff"])
@each("header", ORDERS)
def test_surplus_bytes_do_not_change_a_command_whose_type_is_given(
    header: bytes, fill: bytes, surplus: int
) -> None:
    more = fill * surplus
    plain = arrival(native_twist(header) + more, encoding=TOLD["Twist"], stamp_ns=5)
    assert RECEIVER.command(plain) == RECEIVER.command(
        arrival(native_twist(header), encoding=TOLD["Twist"], stamp_ns=5)
    )
    for frame in (b"", b"base_link"):
        payload = native_stamped(header, frame) + more
        result = RECEIVER.command(arrival(payload, encoding=TOLD["TwistStamped"]))
        assert (result.twist, result.stamp_ns) == (Twist(0.5, 0.2), 3_000_000_004)


@each("size", range(4, 68))
def test_a_twist_is_malformed_if_its_given_type_is_twist_stamped(size: int) -> None:
    payload = (native_twist() + bytes(68))[:size]
    assert refusal(arrival(payload, encoding=TOLD["TwistStamped"])) == "malformed"


@each("size", range(4, 76))
@each("encoding", ["", "application/cdr", TOLD["TwistStamped"]])
def test_a_truncated_native_stamped_twist_is_never_read_as_a_stamped_twist(
    encoding: str, size: int
) -> None:
    payload = native_stamped(ORDERS[1], b"base_link")[:size]
    if encoding != TOLD["TwistStamped"] and 52 <= size < 56:
        # This size is also that of a Twist, and nothing else distinguishes them.
        assert RECEIVER.command(arrival(payload, encoding=encoding)).stamp_ns is None
    else:
        between = encoding != TOLD["TwistStamped"] and 56 <= size < 68
        reason = "wrong_shape" if between else "malformed"
        assert refusal(arrival(payload, encoding=encoding)) == reason


@pytest.mark.parametrize("header", ORDERS)
def test_native_wheel_speeds_are_converted_to_a_twist(header: bytes) -> None:
    payload = native_joints(header, [4.0, 2.0, 2.0, 4.0])
    result = RECEIVER.command(arrival(payload, key="wheel_cmd/app"))
    assert result.twist == wheels(joints(4.0, 2.0, 2.0, 4.0)).twist


@each("header", ORDERS)
@each("bad", NOT_FINITE)
def test_a_native_number_that_is_not_finite_is_refused(header: bytes, bad: float) -> None:
    for place in range(6):
        axes = [0.1 * place] * 6
        axes[place] = bad
        assert refusal(arrival(cdr(header, "6d", *axes))) == "not_finite"
    for place in range(4):
        speeds = [1.0] * 4
        speeds[place] = bad
        payload = native_joints(header, speeds)
        assert refusal(arrival(payload, key="wheel_cmd/app")) == "not_finite"


@each("size", [n for n in range(4, 68) if not 52 <= n <= 55])
def test_a_native_twist_of_another_length_is_refused(size: int) -> None:
    payload = (native_twist() + bytes(68))[:size]
    assert refusal(arrival(payload)) == ("malformed" if size < 52 else "wrong_shape")


@each(
    ("key", "payload"),
    [
        ("cmd/app", native_stamped(ORDERS[1], b"", nanosec=1_000_000_000)),
        ("cmd/app", native_stamped(ORDERS[1], b"\xff\xfe")),
        ("cmd/app", native_stamped(ORDERS[1], b"").replace(b"\x01\0\0\0\0", b"\x01\0\0\0x")),
        ("cmd/app", b"\x00\x01\x00\x00" + b"\xff" * 64),
        ("wheel_cmd/app", native_twist()),
        ("wheel_cmd/app", native_joints(ORDERS[1], [1.0] * 4)[:-1]),
    ],
)
def test_a_native_payload_that_is_not_the_expected_message_is_malformed(
    key: str, payload: bytes
) -> None:
    assert refusal(arrival(payload, key=key)) == "malformed"


def empty_names(size: int) -> bytes:
    """Return a JointState of `size` bytes with as many empty names as fit."""
    count = (size - 24) // 4
    return cdr(ORDERS[1], "iIIB3xI", 0, 0, 1, 0, count) + bytes(4 * count)


def test_too_many_joint_names_are_refused_for_their_number_without_being_decoded() -> None:
    payload = empty_names(MAX_COMMAND_BYTES)
    assert len(payload) == MAX_COMMAND_BYTES
    # the decoder looked at no item
    for more in (payload, payload[:24] + b"\xff" * len(payload[24:])):
        with pytest.raises(DecodeError, match=r"1018 items, but at most 64 are allowed"):
            RECEIVER.command(arrival(more, key="wheel_cmd/app"))


def test_native_wheel_speeds_for_another_number_of_wheels_are_refused() -> None:
    for count in (0, 3, 5):
        payload = native_joints(ORDERS[1], [1.0] * count)
        assert refusal(arrival(payload, key="wheel_cmd/app")) == "wrong_wheels"


def test_a_native_command_has_the_same_size_limit_as_any_other() -> None:
    largest = native_stamped(ORDERS[1], b"f" * 4027) + bytes(4)
    assert len(largest) == MAX_COMMAND_BYTES
    assert RECEIVER.command(arrival(largest)).twist == Twist(0.5, 0.2)
    assert refusal(arrival(largest + b"\0")) == "too_big"


# the transport of a sample


@each(
    "key",
    ["cmd/*", "cmd/**", "**", "*/app", "wheel_cmd/*", "wheel_cmd/**", "cmd/a$*", "*",
     "acsard/*/cmd/app", "cmd/app/anna/more", "cmd/app/*", "acsard/**"],
)  # fmt: skip
def test_a_command_needs_its_exact_key(key: str) -> None:
    assert refused(twist(), key=key) == "wildcard"


@pytest.mark.parametrize("key", ["cmd/app", "wheel_cmd/app"])
def test_a_delete_is_not_a_command(key: str) -> None:
    assert refused(twist(), key=key, put=False) == "not_a_put"


def test_a_command_may_reach_the_size_limit_but_not_exceed_it() -> None:
    text = encode(twist(), "json")
    largest = text + b" " * (MAX_COMMAND_BYTES - len(text))
    assert RECEIVER.command(arrival(largest)).twist == Twist(0.5, 0.2)
    assert refusal(arrival(largest + b" ")) == "too_big"
    assert refusal(arrival(largest + b" ", key="wheel_cmd/app")) == "too_big"


def test_a_wildcard_is_the_reported_reason_of_a_delete_without_payload() -> None:
    assert refusal(arrival(b"", key="cmd/*", put=False)) == "wildcard"


# the clock of a stamp


def test_wheel_commands_are_stamped_in_the_same_way_as_twists() -> None:
    body = joints(1.0, 1.0, 1.0, 1.0)
    header = {"header": {"stamp": {"sec": 9, "nanosec": 1}}}
    assert wheels(body | header, stamp_ns=5).stamp_ns == 9_000_000_001
    assert wheels(body, stamp_ns=5).stamp_ns == 5


def test_the_age_counts_from_the_arrival_and_not_from_the_stamp() -> None:
    assert command(stamped(1), stamp_ns=2).arrived_ns == ARRIVED_NS


# services


@each("verb", ["stop", "deactivate", "reset_odometry"])
@each("payload", [b"", b"{}", b"\xff garbage"])
def test_a_service_without_arguments_ignores_its_payload(verb: Any, payload: bytes) -> None:
    assert Receiver.request(verb, 7, "", payload) == Request(verb, 7)


@each("verb", ["clear", "activate"])
@each("form", ["json", "msgpack"])
def test_clear_and_activate_accept_the_numbers_of_causes(form: Format, verb: Verb) -> None:
    payload = encode({"numbers": [1_800_000_000_123, 7]}, form)
    request = Receiver.request(verb, 7, "", payload, 5)
    assert request == Request(verb, 7, asked_ns=5, numbers=(1_800_000_000_123, 7))


@each("verb", ["clear", "activate"])
@each("payload", [b"", b"{}", b'{"numbers": null}', b"\x80"])
def test_clear_and_activate_may_come_without_a_number(payload: bytes, verb: Verb) -> None:
    assert Receiver.request(verb, 7, "", payload) == Request(verb, 7)


@each(
    "payload",
    [b"\xff garbage", b'{"numbers": ["5"]}', b'{"numbers": [-1]}', b'{"numbers": [5.5]}',
     b'{"stop": 5}', b'{"numbers": [9007199254740992]}', b'{"numbers": 5}', b'{"latch": 5}',
     b'{"numbers": [' + b"1, " * 64 + b"1]}"],
)  # fmt: skip
@each("verb", ["clear", "activate"])
def test_clear_and_activate_refuse_any_other_payload(payload: bytes, verb: Verb) -> None:
    with pytest.raises(DecodeError):
        Receiver.request(verb, 7, "", payload)


@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_set_pose_accepts_x_y_and_yaw(form: Format) -> None:
    payload = encode({"x": 1.5, "y": -2, "yaw": 0.5}, form)
    assert Receiver.request("set_pose", 7, "", payload) == Request(
        "set_pose", 7, Pose(1.5, -2.0, 0.5)
    )


@each(
    ("body", "reason"),
    [
        ({}, "wrong_shape"),
        ({"x": 1.0, "y": 2.0}, "wrong_shape"),
        ({"x": 1.0, "y": 2.0, "yaw": "0"}, "wrong_shape"),
        ({"x": 1.0, "y": 2.0, "yaw": 0.0, "z": 0.0}, "wrong_shape"),
        ({"x": math.nan, "y": 0.0, "yaw": 0.0}, "not_finite"),
        ({"x": 0.0, "y": math.inf, "yaw": 0.0}, "not_finite"),
        ({"x": 0.0, "y": 0.0, "yaw": -math.inf}, "not_finite"),
        ({"x": 1.1e6, "y": 0.0, "yaw": 0.0}, "not_finite"),
        ({"x": 0.0, "y": -1.1e6, "yaw": 0.0}, "not_finite"),
    ],
)
def test_set_pose_refuses_a_payload_that_is_not_a_pose(body: object, reason: str) -> None:
    with pytest.raises(DecodeError) as caught:
        Receiver.request("set_pose", 7, "", msgspec.msgpack.encode(body))
    assert caught.value.reason == reason


def test_set_pose_needs_a_payload() -> None:
    with pytest.raises(DecodeError):
        Receiver.request("set_pose", 7, "", b"")


# damage

BODIES: list[tuple[str, dict[str, Any]]] = [
    ("cmd/app", twist()),
    ("cmd/app", stamped(1_700_000_000, 5)),
    ("cmd/app", {"linear": {}, "angular": {}}),
    ("wheel_cmd/app", joints(1.0, -2.0, 3.5, 0.0)),
]
VALID = [(key, written(body, form)) for key, body in BODIES for form in FORMATS]
VALID += [
    ("cmd/app", native_twist(ORDERS[0])),
    ("cmd/app", native_stamped(ORDERS[0], b"base_link")),
    ("wheel_cmd/app", native_joints(ORDERS[0], [1.0, -2.0, 3.5, 0.0])),
]

NASTY = [
    b"\x00", b"\xff", b"\xc0", b"\xc1", b"\xed\xa0\x80", b"\xdd\xff\xff\xff\xff",
    b"\xdb\x7f\xff\xff\xff", b"\x91" * 1500, b"[" * 1500, b'{"linear":' * 300,
    b"\x81\xa6linear" * 400, b"NaN", b"1e999", b"-",
    b"\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00", b"\xca\xff\x80\x00\x00", b"\xcf" + b"\xff" * 8,
    b"\xd3\x80" + b"\x00" * 7, b"9" * 60, b"\\ud800", b'"', b"}", b"\xc9\x7f\xff\xff\xff\x01",
]  # fmt: skip


def damage(payload: bytes, other: bytes, rnd: random.Random) -> bytes:
    """Return a valid payload with one or two random changes.

    A change flips bits, cuts, copies or splices bytes, or replaces a number.
    """
    for _ in range(rnd.randint(1, 2)):
        a = rnd.randrange(len(payload) + 1)
        b = min(len(payload), a + rnd.randint(0, 12))
        match rnd.randrange(7):
            case 0 if payload:
                i = rnd.randrange(len(payload))
                payload = (
                    payload[:i] + bytes([payload[i] ^ 1 << rnd.randrange(8)]) + payload[i + 1 :]
                )
            case 1:
                payload = payload[:a]
            case 2:
                payload = payload[:a] + payload[b:]
            case 3:
                payload = payload[:b] + payload[a:]
            case 4:
                payload = payload[:a] + other[rnd.randrange(len(other) + 1) :]
            case 5:
                # The length is right but the value is not a number, which JSON cannot write.
                number = rnd.choice([math.nan, math.inf, -math.inf, 1e308, -5e-324])
                i = payload.find(b"\xcb", a)
                if payload[:1] == b"\0":
                    i = 4 + (a & ~7)
                    payload = payload[:i] + struct.pack("<d", number) + payload[i + 8 :]
                elif i >= 0:
                    payload = payload[:i] + msgspec.msgpack.encode(number) + payload[i + 9 :]
            case _:
                payload = payload[:a] + rnd.choice(NASTY) + payload[b:]
    return payload


@pytest.mark.slow
def test_twenty_thousand_damaged_payloads_raise_nothing_but_decode_errors() -> None:
    rnd = random.Random(20_000)
    encodings = ["", "", "", "application/json", "application/msgpack", "application/cdr"]
    reasons: dict[str, int] = {}
    for _ in range(20_000):
        key, payload = rnd.choice(VALID)
        data = damage(payload, rnd.choice(VALID)[1], rnd)
        try:
            result = RECEIVER.command(arrival(data, key, encoding=rnd.choice(encodings)))
        except DecodeError as error:
            reasons[error.reason] = reasons.get(error.reason, 0) + 1
            msgspec.json.encode(str(error))  # its text is published
        else:
            assert math.isfinite(result.twist.linear)
            assert math.isfinite(result.twist.angular)
            assert result.arrived_ns == ARRIVED_NS
            reasons["accepted"] = reasons.get("accepted", 0) + 1
    expected = {"accepted", "malformed", "wrong_shape", "unknown_encoding", "wrong_wheels"}
    assert expected | {"not_finite", "too_big"} == set(reasons)


@each("digits", [19, 40, 400, 4000])
def test_a_stamp_beyond_any_clock_is_refused(digits: int) -> None:
    body = '{"header":{"stamp":{"sec":%s}},"twist":{"linear":{},"angular":{}}}' % ("9" * digits)
    with pytest.raises(DecodeError):
        RECEIVER.command(arrival(body.encode()))


def test_a_huge_stamp_never_makes_the_arbiter_raise() -> None:
    body = '{"header":{"stamp":{"sec":%s}},"twist":{"linear":{},"angular":{}}}' % ("9" * 400)
    try:
        result = RECEIVER.command(arrival(body.encode()))
    except DecodeError:
        return
    Arbiter().accept(result, CommandsConfig())


def test_a_header_beside_a_bare_twist_is_refused() -> None:
    with pytest.raises(DecodeError):
        RECEIVER.command(arrival(b'{"header":{"stamp":{"sec":5}},"linear":{"x":1},"angular":{}}'))


# samples on a ROS key

GID = bytes(range(16))
SENT_NS = 1_700_000_000_000_000_000


def by_ros(via: str, body: dict[str, Any], **changes: Any) -> Arrival:
    fields: dict[str, Any] = {"key": "cmd/nav", "encoding": "application/cdr", "via": via} | changes
    if via == "rmw":
        fields.setdefault("attachment", Attachment(1, SENT_NS, GID).pack())
    return arrival(written(body, "cdr"), **fields)


def test_over_rmw_the_attachment_gives_the_sender_and_the_stamp() -> None:
    command = RECEIVER.command(by_ros("rmw", twist(), stamp_ns=5, sender="router"))
    gid = f"gid {public_name(GID.hex())}"
    assert command == Command(
        "nav", Twist(0.5, 0.2), ARRIVED_NS, SENT_NS, gid, gid, sequence=1, ros=True
    )


@pytest.mark.parametrize(
    ("attachment", "reason"),
    [
        (b"", "no_attachment"),
        (b"rqh" + bytes(17), "bad_attachment"),
        (Attachment(1, SENT_NS, GID).pack() + b"x", "bad_attachment"),
    ],
)
def test_over_rmw_a_command_without_a_valid_attachment_is_refused(
    attachment: bytes, reason: str
) -> None:
    assert refusal(by_ros("rmw", twist(), attachment=attachment)) == reason


def test_the_attachment_of_a_command_from_a_bridge_is_ignored() -> None:
    command = RECEIVER.command(by_ros("bridge", twist(), attachment=b"rqh" + bytes(17)))
    assert command.twist == Twist(0.5, 0.2)
    assert command.stamp_ns is None


@pytest.mark.parametrize("via", ["bridge", "rmw"])
def test_joint_commands_from_ros_are_wheel_speeds_of_their_source(via: str) -> None:
    command = RECEIVER.command(
        by_ros(via, joints(6.0, 2.0, 2.0, 6.0), key="wheel_cmd/ros2_control")
    )
    assert command.source == "ros2_control"
    assert command.twist == KINEMATICS.twist(WheelSpeeds(6.0, 2.0, 2.0, 6.0))


@pytest.mark.parametrize("via", ["bridge", "rmw"])
def test_joint_commands_before_the_controller_is_active_are_refused(via: str) -> None:
    nan = by_ros(via, joints(math.nan, 0.0, 0.0, 0.0), key="wheel_cmd/ros2_control")
    assert refusal(nan) == "not_finite"


@pytest.mark.parametrize("via", ["bridge", "rmw"])
def test_a_wildcard_put_or_a_delete_on_a_ros_key_is_refused(via: str) -> None:
    assert refusal(by_ros(via, twist(), key="cmd_*")) == "wildcard"
    assert refusal(by_ros(via, twist(), put=False)) == "not_a_put"


def test_the_clock_of_a_header_is_kept_apart_from_that_of_a_stamping_router() -> None:
    """One clock stamps the messages of all senders behind a router.

    The stamp in a message's header comes from the sender's own clock.
    """
    arbiter, reasons = Arbiter(), []
    for step in range(20):
        at_ns = ARRIVED_NS + step * 50_000_000
        now_ns = SENT_NS + step * 50_000_000
        slow = stamped(*divmod(now_ns - 10**9, 10**9))
        for body, key in ((twist(), "cmd/nav"), (slow, "cmd/teleop")):
            sample = replace(
                by_ros("bridge", body, key=key, stamp_ns=now_ns, sender="router"), arrived_ns=at_ns
            )
            refused = arbiter.accept(RECEIVER.command(sample), CommandsConfig())
            reasons.append("" if refused is None else refused.what)
    assert set(reasons[:10]) == {"unproven"}
    assert set(reasons[12:]) == {""}


# the sender


def test_the_sender_over_rmw_is_the_publisher() -> None:
    other = Attachment(1, SENT_NS, bytes(16)).pack()
    name = f"gid {public_name(GID.hex())}"
    assert RECEIVER.command(by_ros("rmw", twist(), sender="router")).sender == name
    assert RECEIVER.command(by_ros("rmw", twist(), attachment=other)).sender != name


def test_an_unreadable_command_has_the_same_sender_as_a_readable_one() -> None:
    good = arrival(written(twist(), "json"), sender="z1", stamp_ns=5)
    bad = claimed_identity(replace(good, payload=b"hello"))
    assert (bad.sender, bad.shared) == (RECEIVER.command(good).sender, True)
    ros = by_ros("rmw", twist())
    bad = claimed_identity(replace(ros, payload=b""))
    assert (bad.sender, bad.shared) == (RECEIVER.command(ros).sender, False)


def test_half_a_gid_is_not_taken_for_another_sender() -> None:
    nameless = public_name("z1")
    half = by_ros("rmw", twist(), attachment=bytes.fromhex(nameless))
    assert claimed_identity(half).sender == ""


# the project's own attachment


JOYSTICK = public_name("joystick/s3cret")


def signed(**fields: Any) -> bytes:
    return msgspec.msgpack.encode({"sender": "joystick/s3cret"} | fields)


@pytest.mark.parametrize(
    ("ahead_ns", "replaced"), [(0, False), (500_000_000, False), (500_000_001, True)]
)
def test_a_stamp_more_than_half_a_second_ahead_counts_as_replaced_by_zenoh(
    ahead_ns: int, replaced: bool
) -> None:
    attachment = signed(stamp=SENT_NS + ahead_ns)
    result = command(twist(), attachment=attachment, received_ns=SENT_NS)
    assert result.stamp_replaced == replaced
    assert result.stamp_ns == SENT_NS + ahead_ns
    assert not command(twist(), attachment=attachment).stamp_replaced
    assert not command(twist(), received_ns=SENT_NS).stamp_replaced


GID_NAME = f"gid {public_name(GID.hex())}"
Z1, ROUTER = f"session {public_name('z1')}", public_name("router")


def ours(body: dict[str, Any], **changes: Any) -> Arrival:
    return arrival(written(body, "json"), **changes)


IDENTITIES: dict[str, tuple[Arrival, str, str, int | None, bool]] = {
    "a key alone": (ours(twist()), "native/app", "native/app", None, True),
    "wheels": (
        ours(joints(1.0, 1.0, 1.0, 1.0), key="wheel_cmd/app"), "native/app", "native/app", None,
        True,
    ),
    "a session that stamps": (ours(twist(), sender="z1", stamp_ns=5), Z1, Z1, 5, True),
    "a header": (ours(stamped(12)), "native/app", HEADER_S, 12 * 10**9, True),
    "a header, stamped": (
        ours(stamped(12), sender="z1", stamp_ns=5), Z1, f"{Z1}, header on native/cmd/app",
        12 * 10**9, True,
    ),
    "a header of zero": (ours(stamped(0)), "native/app", "native/app", None, True),
    "a header of 0, stamped": (ours(stamped(0), sender="z1", stamp_ns=5), Z1, Z1, 5, True),
    "rmw": (by_ros("rmw", twist(), sender="router"), GID_NAME, GID_NAME, SENT_NS, False),
    "rmw, a header": (
        by_ros("rmw", stamped(12, 34)), GID_NAME, f"{GID_NAME}, header on rmw/cmd/nav",
        12_000_000_034, False,
    ),
    "rmw, a header of zero": (by_ros("rmw", stamped(0)), GID_NAME, GID_NAME, SENT_NS, False),
    "a bridge": (by_ros("bridge", twist()), "bridge/nav", "bridge/nav", None, True),
    "a bridge that stamps": (
        by_ros("bridge", twist(), stamp_ns=SENT_NS, sender="router"), f"bridge/{ROUTER}",
        f"bridge/{ROUTER}", SENT_NS, True,
    ),
    "a bridge, our attachment": (
        by_ros("bridge", twist(), attachment=signed()), "bridge/nav", "bridge/nav", None, True,
    ),
    "our attachment": (
        ours(twist(), attachment=signed(stamp=9, sequence=3), sender="z1", stamp_ns=5),
        JOYSTICK, JOYSTICK, 9, False,
    ),
    "our attachment and a header": (
        ours(stamped(12), attachment=signed(stamp=9)), JOYSTICK,
        f"{JOYSTICK}, header on native/cmd/app", 12 * 10**9, False,
    ),
    "our attachment without a stamp": (
        ours(twist(), attachment=signed()), JOYSTICK, JOYSTICK, None, False,
    ),
    **{
        f"another attachment, {one!r}": (
            ours(twist(), attachment=one), "native/app", "native/app", None, True,
        )
        for one in (b"trace", b"{}", b"\x80", signed()[:-1])
    },
}  # fmt: skip
"""A sample with its sender, its clock, its stamp, and whether many may look like its sender."""


@each("case", IDENTITIES)
def test_a_sample_gives_its_sender_clock_and_stamp(case: str) -> None:
    sample, *expected = IDENTITIES[case]
    result = RECEIVER.command(sample)
    assert [result.sender, result.clock, result.stamp_ns, result.shared] == expected


def test_an_attachment_without_a_stamp_uses_the_stamp_of_zenoh() -> None:
    result = command(twist(), attachment=signed(sequence=3), sender="z1", stamp_ns=5)
    assert (result.stamp_ns, result.sequence) == (5, 3)


# the echo of a beat

RUN, BEAT_US = 181_349_028_416_577, 83_214_500_123
BEAT = {"run": RUN, "boot_us": BEAT_US}


@each("form", [msgspec.json.encode, msgspec.msgpack.encode])
def test_the_age_of_a_command_with_an_echo_is_its_arrival_minus_the_beat(form: Any) -> None:
    receiver = Receiver(JointsConfig(), KINEMATICS, RUN)
    attachment = form({"sender": "joystick/s3cret", "echo": BEAT})
    boot_ns = (BEAT_US + 7) * 1000
    sample = arrival(written(twist(), "json"), attachment=attachment, boot_ns=boot_ns)
    result = receiver.command(sample)
    assert (result.echo, result.age_ns) == (Echo(RUN, BEAT_US * 1000), 7000)
    other_run = Receiver(JointsConfig(), KINEMATICS, RUN + 1).command(sample)
    assert (other_run.echo, other_run.age_ns) == (result.echo, None)
    plain = receiver.command(replace(sample, attachment=form({"sender": "joystick/s3cret"})))
    assert (plain.echo, plain.age_ns) == (None, None)


@each("form", [msgspec.json.encode, msgspec.msgpack.encode])
@each(
    "echo",
    [
        BEAT | {"run": str(RUN)},
        BEAT | {"run": -1},
        BEAT | {"run": 1 << 48},
        BEAT | {"boot_us": 1.5},
        BEAT | {"boot_us": True},
        BEAT | {"boot_us": 1 << 53},
        {"run": RUN},
        [RUN, BEAT_US],
        BEAT_US,
        {},
    ],
)
def test_a_command_whose_echo_is_not_a_beat_is_refused(form: Any, echo: object) -> None:
    attachment = form({"sender": "joystick/s3cret", "echo": echo})
    with pytest.raises(DecodeError, match="copy the newest message") as raised:
        RECEIVER.command(arrival(written(twist(), "json"), attachment=attachment))
    assert raised.value.reason == "bad_echo"
    assert caller_name("native", attachment) == "unnamed (native)"  # a stop still stops


def test_an_echo_without_a_sender_is_refused() -> None:
    sample = arrival(written(twist(), "json"), attachment=msgspec.json.encode({"echo": BEAT}))
    with pytest.raises(DecodeError, match="beside `sender`"):
        RECEIVER.command(sample)


# certificates


def test_the_certificate_in_the_key_is_part_of_the_sender_name() -> None:
    receiver = Receiver(JointsConfig(), KINEMATICS)
    sample = arrival(written(twist(), "json"), key="cmd/app/anna", attachment=signed(stamp=9))
    result = receiver.command(sample)
    assert (result.source, result.sender, result.clock) == ("app", *[f"{JOYSTICK} [anna]"] * 2)
    assert claimed_identity(sample).sender == result.sender
    by_zenoh = receiver.command(replace(sample, attachment=b"", sender="z1", stamp_ns=5))
    assert by_zenoh.sender == f"{Z1} [anna]"
    by_key = receiver.command(replace(sample, attachment=b""))
    assert (by_key.sender, by_key.shared) == ("native/app/anna", True)


@pytest.mark.parametrize(("first", "second"), [("", "/anna"), ("/anna", ""), ("/anna", "/ben")])
def test_a_sender_id_under_a_second_certificate_is_refused(first: str, second: str) -> None:
    receiver = Receiver(JointsConfig(), KINEMATICS)
    sample = arrival(written(twist(), "json"), key=f"cmd/app{first}", attachment=signed())
    receiver.command(sample)
    with pytest.raises(DecodeError, match="already in use") as raised:
        receiver.command(replace(sample, key=f"cmd/app{second}"))
    assert raised.value.reason == "other_certificate"
    assert receiver.command(sample).sender == claimed_identity(sample).sender


def test_shared_and_ros_senders_are_not_bound_to_a_certificate() -> None:
    receiver = Receiver(JointsConfig(), KINEMATICS)
    receiver.command(arrival(written(twist(), "json"), key="cmd/app/anna", attachment=signed()))
    bridged = by_ros("bridge", twist(), key="cmd/app", attachment=signed())
    assert receiver.command(bridged).sender == "bridge/app"
    for key, session in product(("cmd/app", "cmd/app/anna", "cmd/app/ben"), ("", "z1")):
        stamp_ns = 5 if session else None
        sample = arrival(written(twist(), "json"), key=key, sender=session, stamp_ns=stamp_ns)
        assert receiver.command(sample).shared


def test_a_sender_id_is_never_taken_for_a_session_that_stamps_for_others() -> None:
    """The zero of a sender id arms it at once, but the zero of a router's session does not.

    A sender must not get the other treatment by using the session's id, which is not secret.
    """
    stamped_by = command(twist(), sender="z1", stamp_ns=5).sender
    for name in ("z1", "session z1", "session/z1", f"{stamped_by}/z1"):
        attachment = msgspec.msgpack.encode({"sender": name})
        assert command(twist(), attachment=attachment).sender != stamped_by


# senders bound to certificates


def test_the_first_certificate_keeps_a_sender_id_while_it_sends() -> None:
    bindings = Bindings()
    for at_ns in range(0, 5 * BINDING_NS, BINDING_NS // 2):
        assert bindings.bind("a", "anna", at_ns) is None
        assert bindings.bind("a", "ben", at_ns + 1) == "anna"
        assert bindings.bind("a", "", at_ns + 1) == "anna"
    assert bindings.bind("b", "ben", at_ns) is None


def test_a_sender_id_without_a_certificate_is_bound_to_this_machine() -> None:
    bindings = Bindings()
    assert bindings.bind("a", "", 0) is None
    assert bindings.bind("a", "anna", 1) == ""


def test_a_binding_ends_after_a_silence_and_refused_commands_do_not_extend_it() -> None:
    bindings = Bindings()
    bindings.bind("a", "anna", 0)
    assert bindings.bind("a", "ben", BINDING_NS) == "anna"
    assert bindings.bind("a", "ben", BINDING_NS + 1) is None
    assert bindings.bind("a", "anna", BINDING_NS + 2) == "ben"


def test_a_flood_of_sender_ids_is_bounded_in_memory_and_active_senders_stay_bound() -> None:
    bindings = Bindings()
    bindings.bind("a", "anna", 0)
    for number in range(4 * MAX_BINDINGS):
        bindings.bind(f"other {number}", "ben", number)
        if number % 100 == 0:
            assert bindings.bind("a", "anna", number) is None
    assert bindings.bind("a", "ben", number) == "anna"
    assert len(bindings._seen) <= MAX_BINDINGS


# the name of a caller


def signed_as(name: str) -> bytes:
    return msgspec.json.encode({"sender": name})


def test_a_native_caller_has_the_name_in_its_attachment() -> None:
    for form in (msgspec.json, msgspec.msgpack):
        signature = form.encode({"sender": "alice@laptop patrol/s3cret", "sequence": 7})
        assert caller_name("native", signature) == "alice@laptop patrol/b8978a0526b85c8d (native)"


@each(
    "attachment",
    [b"", b"joe", b"{}", b'{"sender": 7}', b'{"sender": "\xff"}', b"\x81", signed_as("")],
)
def test_a_caller_without_a_valid_name_is_unnamed(attachment: bytes) -> None:
    assert caller_name("native", attachment) == "unnamed (native)"


def test_a_stamped_call_names_the_session_that_stamped_it() -> None:
    session = public_name("1f2e")
    assert caller_name("native", b"", "1f2e") == f"unnamed (native, session {session})"


def test_an_rmw_caller_is_named_by_its_gid() -> None:
    gid = bytes(range(16))
    assert caller_name("rmw", bytes(17) + gid) == f"unnamed (rmw {gid.hex()})"


def test_a_caller_through_a_bridge_is_unnamed() -> None:
    assert caller_name("bridge", b"rqh" + bytes(17)) == "unnamed (bridge)"


@each(
    ("name", "public"),
    [
        ("mallory (rmw 00)", "mallory ?rmw 00?"),
        ("a, b", "a? b"),
        ("a\nACSARD_EVENT=stop", "a?ACSARD_EVENT?stop"),
        ("\x1b[2J", "??2J"),
        ("\u202elaptop", "?laptop"),
        ("Jürgen", "Jürgen"),
    ],
)
def test_a_caller_name_cannot_imitate_the_text_around_it(name: str, public: str) -> None:
    caller = caller_name("native", signed_as(f"{name}/s3cret"))
    assert caller == f"{public}/{public_name(f'{name}/s3cret')[-HASH_DIGITS:]} (native)"


@given(st.binary(max_size=100) | st.text(max_size=100).map(signed_as))
def test_any_attachment_gives_a_short_printable_name(attachment: bytes) -> None:
    caller = caller_name("native", attachment)
    name = caller.removesuffix(" (native)")
    assert caller == f"{name} (native)"
    assert 1 <= len(name) <= MAX_NAME_LENGTH + 1 + HASH_DIGITS
    assert name.isprintable()
    assert not set(name) & set('(),="\n')
