"""A payload on a command key or of a service becomes a command or a request, or is refused.

The only error is `DecodeError`, and `state` counts its reason.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import CommandsConfig, Config, DriveConfig, McuConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode
from acsard.core.messages.refusals import MAX_COMMAND_BYTES
from acsard.core.messages.schema import JointState, TwistStamped
from acsard.core.messages.schema import Twist as TwistMessage
from acsard.core.motion.arbiter import Arbiter
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Pose, Request, Twist, Verb
from tests.each import each
from tests.wheels import TWO

KINEMATICS = Kinematics(DriveConfig())
JOINTS = list(Config().joint_names)
RECEIVER = Receiver(JOINTS, KINEMATICS)
BOTH = list(Config(mcu=McuConfig(wheels=TWO)).joint_names)
RECEIVER_OF_TWO = Receiver(BOTH, KINEMATICS)
ARRIVED_NS = 77_000_000_000
AXES = [(part, axis) for part in ("linear", "angular") for axis in "xyz"]
NOT_FINITE = [math.nan, math.inf, -math.inf]
DRIVEN = Twist(0.5, 0.2)


def arrival(payload: bytes, key: str = "cmd/app", **changes: Any) -> Arrival:
    fields: dict[str, Any] = {"put": True, "encoding": "", "stamp_ns": None, "sender": ""} | changes
    return Arrival(key=key, payload=payload, arrived_ns=ARRIVED_NS, **fields)


def written(body: dict[str, Any], form: Format) -> bytes:
    """Encode a command. CDR has no names of fields, so they become those of a message first."""
    if form != "cdr":
        return encode(body, form)
    cls = TwistStamped if "twist" in body else JointState if "name" in body else TwistMessage
    return encode(msgspec.convert(body, cls), form)


def verdict(
    payload: bytes, key: str = "cmd/app", receiver: Receiver = RECEIVER, **changes: Any
) -> Twist | str:
    try:
        return receiver.command(arrival(payload, key, **changes)).twist
    except DecodeError as error:
        return error.reason


def twist(linear: float = 0.5, angular: float = 0.2) -> dict[str, Any]:
    return {"linear": {"x": linear}, "angular": {"z": angular}}


def stamped(sec: int, nanosec: int = 0) -> dict[str, Any]:
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}}, "twist": twist()}


def joints(*velocity: float, names: list[str] | None = None, **others: Any) -> dict[str, Any]:
    return {"name": names or JOINTS, "velocity": list(velocity)} | others


def one(part: str, axis: str, value: float, of: dict[str, Any] | None = None) -> dict[str, Any]:
    body = of or twist()
    return body | {part: body[part] | {axis: value}}


ACCEPTED: list[tuple[str, dict[str, Any], Twist]] = [
    ("cmd/app", twist(), DRIVEN),
    ("cmd/app", stamped(3, 4), DRIVEN),
    ("cmd/app", {"linear": {}, "angular": {}}, Twist()),
    ("cmd/app", {"linear": {"x": -1.5}, "angular": {}}, Twist(-1.5, 0.0)),
    # Axes that the base cannot follow.
    ("cmd/app", {"linear": {"x": 4, "y": 2, "z": 3}, "angular": {"x": 5, "y": 6, "z": 1}},
     Twist(4.0, 1.0)),
    ("wheel_cmd/app", joints(4.0, 2.0, 2.0, 4.0), Twist(0.15, 1 / 3)),
    ("wheel_cmd/app", joints(5.0, 1.0, 3.0, 3.0), Twist(0.15, 1 / 3)),  # the mean of each side
    ("wheel_cmd/app", joints(2.0, 4.0, 4.0, 2.0, names=[*JOINTS[2:], *JOINTS[:2]]),
     Twist(0.15, 1 / 3)),
    ("wheel_cmd/app", joints(4.0, 9.0, 2.0, 2.0, 4.0, names=[JOINTS[0], "arm", *JOINTS[1:]],
                             position=[0.5] * 5), Twist(0.15, 1 / 3)),
]  # fmt: skip


@each(("key", "body", "expected"), ACCEPTED)
@each("form", FORMATS)
@each("named", [False, True])
def test_a_command_in_any_encoding_is_accepted(
    key: str, body: dict[str, Any], expected: Twist, form: Format, named: bool
) -> None:
    encoding = f"application/{form};acsard.Twist.v1" if named and "twist" not in body else ""
    encoding = "" if "wheel" in key else encoding
    found = verdict(written(body, form), key, encoding=encoding)
    assert isinstance(found, Twist)
    assert (found.linear, found.angular) == pytest.approx((expected.linear, expected.angular))


WRONG_SHAPES: list[Any] = [
    {}, {"header": {}}, {"twist": {}}, {"x": 1.0}, twist() | {"gain": 1},
    {"linear": {"x": 0.5}}, {"angular": {"z": 0.5}}, {"header": {}, "twist": {"linear": {}}},
    {"linear": {"x": 1, "X": 2}, "angular": {}}, {"linear": {"x": "1"}, "angular": {}},
    {"linear": {"x": None}, "angular": {}}, {"linear": 1.0, "angular": 1.0},
    {"linear": [1, 0, 0], "angular": [0, 0, 0]}, {"twist": twist(), "linear": {"x": 1}},
    {"twist": twist(), "linear": {"x": 1}, "angular": {}},
    {"twist": twist(), "header": {"stamp": 5}}, {"twist": twist(), "header": {"seq": 1}},
    {"twist": {"twist": twist()}}, joints(1.0, 1.0, 1.0, 1.0),
    {"header": {"stamp": {"sec": 5}}, "linear": {"x": 1}, "angular": {}},
]  # fmt: skip
WRONG_WHEELS: list[Any] = [
    {}, joints(), joints(1.0, 2.0, 3.0), joints(*[1.0] * 5), joints(*[1.0] * 3, names=JOINTS[:3]),
    *(joints(*[1.0] * len(names), names=names) for names in (
        [*JOINTS[:3], JOINTS[0]], [*JOINTS[:3], "arm"], [*JOINTS[:3], "arm", "hand"],
        [*JOINTS, JOINTS[0]])),
    *(joints(*[1.0] * 4, names=[*JOINTS, more]) for more in (JOINTS[0], "arm")),
    {"velocity": [1.0, 2.0, 3.0, 4.0]}, {"name": JOINTS, "position": [1.0, 2.0, 3.0, 4.0]},
]  # fmt: skip
REFUSED: list[tuple[str, Any, str]] = [
    *(("cmd/app", body, "wrong_shape") for body in WRONG_SHAPES),
    ("wheel_cmd/app", twist(), "wrong_shape"),
    *(("cmd/app", one(*axis, bad), "not_finite") for axis in AXES for bad in NOT_FINITE),
    *(("cmd/app", {"header": {}, "twist": one(*axis, math.nan)}, "not_finite") for axis in AXES),
    *(("wheel_cmd/app", body, "wrong_wheels") for body in WRONG_WHEELS),
    *(("wheel_cmd/app", joints(*(bad if at == n else 1.0 for n in range(4))), "not_finite")
      for at in range(4) for bad in NOT_FINITE),
    *(("wheel_cmd/app", joints(*[1.0] * 4) | {unused: [0.0, math.nan]}, "not_finite")
      for unused in ("position", "effort")),
    ("wheel_cmd/app", joints(*[1e308] * 4), "not_finite"),  # overflows
    ("wheel_cmd/app", joints(1e308, -1e308, -1e308, 1e308), "not_finite"),
    *((key, twist(), "wildcard") for key in (
        "cmd/*", "cmd/**", "**", "*/app", "wheel_cmd/*", "wheel_cmd/**", "cmd/a$*", "*",
        "acsard/*/cmd/app", "cmd/app/anna/more", "cmd/app/*", "acsard/**")),
]  # fmt: skip


@each(("key", "body", "reason"), REFUSED)
def test_any_other_command_is_refused_with_its_reason(key: str, body: Any, reason: str) -> None:
    assert verdict(msgspec.msgpack.encode(body), key) == reason


def test_a_delete_and_a_wildcard_and_one_byte_too_many_are_refused() -> None:
    for key in ("cmd/app", "wheel_cmd/app"):
        assert verdict(written(twist(), "json"), key, put=False) == "not_a_put"
        assert verdict(bytes(MAX_COMMAND_BYTES + 1), key) == "too_big"
    assert verdict(b"", "cmd/*", put=False) == "wildcard"
    text = encode(twist(), "json")
    assert verdict(text + b" " * (MAX_COMMAND_BYTES - len(text))) == DRIVEN


def test_wheel_commands_use_the_configured_joint_names() -> None:
    receiver = Receiver(("fr", "fl", "rl", "rr"), KINEMATICS)
    body = joints(*[1.0] * 4, names=["rl", "fr", "rr", "fl"])
    sample = arrival(msgspec.msgpack.encode(body), key="wheel_cmd/app")
    assert receiver.command(sample).twist.linear == pytest.approx(0.05)
    assert verdict(sample.payload, sample.key) == "wrong_wheels"


def both(*velocity: float, names: list[str] | None = None, **others: Any) -> dict[str, Any]:
    return joints(*velocity, names=names or BOTH, **others)


@each(
    ("body", "expected"),
    [
        (both(4.0, 2.0), Twist(0.15, 1 / 3)),
        (both(2.0, 4.0, names=BOTH[::-1]), Twist(0.15, 1 / 3)),
        (both(4.0, 9.0, 2.0, names=[BOTH[0], "arm", BOTH[1]]), Twist(0.15, 1 / 3)),
        (both(-5.0, 5.0), Twist(0.0, -5 / 3)),
        (both(1.0), "wrong_wheels"), (both(1.0, 2.0, 3.0), "wrong_wheels"),
        (both(1.0, 1.0, names=BOTH[:1]), "wrong_wheels"),
        (both(1.0, 1.0, names=[BOTH[0]] * 2), "wrong_wheels"),
        (both(1.0, 1.0, 1.0, names=[*BOTH, BOTH[0]]), "wrong_wheels"),
        (joints(1.0, 1.0, 1.0, 1.0), "wrong_wheels"),
        (both(1.0, math.nan), "not_finite"), (both(1e308, 1e308), "not_finite"),
        (both(1.0, 1.0, effort=[math.inf]), "not_finite"),
    ],
)  # fmt: skip
def test_a_wheel_command_for_two_wheels_names_both(
    body: dict[str, Any], expected: Twist | str
) -> None:
    found = verdict(written(body, "msgpack"), "wheel_cmd/app", receiver=RECEIVER_OF_TWO)
    if isinstance(expected, str) or isinstance(found, str):
        assert found == expected
        return
    assert (found.linear, found.angular) == pytest.approx((expected.linear, expected.angular))


# A zero only counts as neutral if nothing else was meant.


@each("form", FORMATS)
@each(
    ("key", "body", "cancelled"),
    [
        *(("wheel_cmd/app", joints(*speeds), cancelled) for speeds, cancelled in (
            ((0.0, 0.0, 0.0, 0.0), False), ((-0.0, 0.0, -0.0, 0.0), False),
            ((5.0, 5.0, -5.0, -5.0), True),  # front against rear wheels
            ((5.0, 0.0, 0.0, -5.0), True),  # the right wheels against each other
            ((5.0, 5.0, 5.0, 5.0), False), ((5.0, -5.0, -5.0, 5.0), False))),
        ("cmd/app", twist(0.0, 0.0), False),
        *(("cmd/app", one(*axis, 0.5, twist(0.0, 0.0)), axis not in (AXES[0], AXES[5]))
          for axis in AXES),
        *(("cmd/app", {"header": {}, "twist": one(*axis, 0.5, twist(0.0, 0.0))}, True)
          for axis in AXES[1:5]),
    ],
)  # fmt: skip
def test_a_command_that_cancels_out_is_marked_and_does_not_count_as_neutral(
    form: Format, key: str, body: dict[str, Any], cancelled: bool
) -> None:
    assert RECEIVER.command(arrival(written(body, form), key)).cancelled is cancelled


# Payloads as ROS 2 itself writes them.

BIG, LITTLE = b"\x00\x00\x00\x00", b"\x00\x01\x00\x00"
TOLD = "application/cdr;geometry_msgs/msg/"


def cdr(header: bytes, layout: str, *values: object) -> bytes:
    return header + struct.pack((">" if header == BIG else "<") + layout, *values)


def native_twist(header: bytes = LITTLE, *axes: float) -> bytes:
    return cdr(header, "6d", *(axes or (0.5, 0, 0, 0, 0, 0.2)))


def native_stamped(header: bytes, frame: bytes, nanosec: int = 4) -> bytes:
    layout = f"iII{len(frame) + 1}s{-(12 + len(frame) + 1) % 8}x6d"
    return cdr(header, layout, 3, nanosec, len(frame) + 1, frame, 0.5, 0, 0, 0, 0, 0.2)


def native_joints(header: bytes, velocity: list[float]) -> bytes:
    names = b""
    for joint in JOINTS:
        names += bytes(-len(names) % 4)
        names += cdr(header, f"I{len(joint) + 1}s", len(joint) + 1, joint.encode())[4:]
    body = cdr(header, "iIIB3xI", 0, 0, 1, 0, len(JOINTS)) + names + bytes(-len(names) % 4)
    body += cdr(header, "II", 0, len(velocity))[4:]
    body += bytes(-(len(body) - 4) % 8)
    return body + cdr(header, f"{len(velocity)}dI", *velocity, 0)[4:]


@each("header", [BIG, LITTLE])
@each("encoding", ["", "zenoh/bytes", "application/cdr", TOLD])
@each("more", [b"", b"\x00" * 3, b"\xff" * 3, b"\xff" * 200])
def test_native_commands_may_have_any_padding(header: bytes, encoding: str, more: bytes) -> None:
    told = encoding == TOLD
    if len(more) > 3 and not told:
        return  # without its type, a payload is known by its size
    plain = native_twist(header) + more
    assert verdict(plain, encoding=encoding + "Twist" * told) == DRIVEN
    for frame in (b"", b"base_link", b"f" * 200):
        payload = native_stamped(header, frame) + more
        found = RECEIVER.command(arrival(payload, encoding=encoding + "TwistStamped" * told))
        assert (found.twist, found.stamp_ns) == (DRIVEN, 3_000_000_004)
    wheels = native_joints(header, [4.0, 2.0, 2.0, 4.0])
    found = RECEIVER.command(arrival(wheels, "wheel_cmd/app"))
    assert (found.twist.linear, found.twist.angular) == pytest.approx((0.15, 1 / 3))


@each("size", range(4, 76))
@each("encoding", ["", "application/cdr", f"{TOLD}TwistStamped"])
def test_a_cut_native_command_needs_the_size_of_a_twist(encoding: str, size: int) -> None:
    told = encoding.endswith("Stamped")
    payload = native_stamped(LITTLE, b"base_link")[:size]
    if not told and 52 <= size < 56:
        assert RECEIVER.command(arrival(payload, encoding=encoding)).stamp_ns is None
        return
    between = not told and 56 <= size < 68
    assert verdict(payload, encoding=encoding) == ("wrong_shape" if between else "malformed")


EMPTY_NAMES = cdr(LITTLE, "iIIB3xI", 0, 0, 1, 0, 1018) + bytes(4 * 1018)


@each(
    ("key", "payload", "reason"),
    [
        *(("cmd/app", native_twist(header, *(bad if at == n else 0.1 for n in range(6))),
           "not_finite") for header in (BIG, LITTLE) for at in range(6) for bad in NOT_FINITE),
        *(("wheel_cmd/app", native_joints(BIG, [bad, 1.0, 1.0, 1.0]), "not_finite")
          for bad in NOT_FINITE),
        *(("wheel_cmd/app", native_joints(LITTLE, [1.0] * n), "wrong_wheels") for n in (0, 3, 5)),
        ("cmd/app", native_stamped(LITTLE, b"", nanosec=1_000_000_000), "malformed"),
        ("cmd/app", native_stamped(LITTLE, b"\xff\xfe"), "malformed"),
        ("cmd/app", b"\x00\x01\x00\x00" + b"\xff" * 64, "malformed"),
        ("wheel_cmd/app", native_twist(), "malformed"),
        ("wheel_cmd/app", native_joints(LITTLE, [1.0] * 4)[:-1], "malformed"),
        ("wheel_cmd/app", EMPTY_NAMES, "malformed"),  # for their number, before any is read
        ("cmd/app", native_stamped(LITTLE, b"f" * 4027) + bytes(4), DRIVEN),
        ("cmd/app", native_stamped(LITTLE, b"f" * 4027) + bytes(5), "too_big"),
    ],
)  # fmt: skip
def test_the_verdict_about_a_native_payload(key: str, payload: bytes, reason: object) -> None:
    assert verdict(payload, key) == reason


# Services.


NUMBERS = [1_800_000_000_123, 7]
TOO_MANY = b'{"numbers": [' + b"1, " * 64 + b"1]}"


@each("verb", ["clear", "activate"])
@each(
    ("payload", "numbers"),
    [
        *((encode({"numbers": NUMBERS}, form), tuple(NUMBERS)) for form in FORMATS[:2]),
        *((payload, ()) for payload in (b"", b"{}", b'{"numbers": null}', b"\x80")),
        *((payload, None) for payload in (
            b"\xff garbage", b'{"numbers": ["5"]}', b'{"numbers": [-1]}', b'{"numbers": [5.5]}',
            b'{"stop": 5}', b'{"numbers": [9007199254740992]}', b'{"numbers": 5}', b'{"latch": 5}',
            TOO_MANY)),
    ],
)  # fmt: skip
def test_clear_and_activate_take_the_numbers_of_causes_or_none(
    verb: Verb, payload: bytes, numbers: tuple[int, ...] | None
) -> None:
    if numbers is None:
        with pytest.raises(DecodeError):
            Receiver.request(verb, 7, "", payload)
        return
    asked = Request(verb, 7, asked_ns=5)
    expected = msgspec.structs.replace(asked, numbers=numbers) if numbers else asked
    assert Receiver.request(verb, 7, "", payload, 5) == expected


@each(
    ("body", "reason"),
    [
        *(({"x": 1.5, "y": -2, "yaw": 0.5} | wrong, reason) for wrong, reason in (
            ({}, ""), ({"yaw": "0"}, "wrong_shape"), ({"z": 0.0}, "wrong_shape"),
            ({"x": math.nan}, "not_finite"), ({"y": math.inf}, "not_finite"),
            ({"yaw": -math.inf}, "not_finite"), ({"x": 1.1e6}, "not_finite"),
            ({"y": -1.1e6}, "not_finite"))),
        ({}, "wrong_shape"), ({"x": 1.0, "y": 2.0}, "wrong_shape"),
    ],
)  # fmt: skip
def test_set_pose_takes_x_y_and_yaw(body: dict[str, Any], reason: str) -> None:
    payload = msgspec.msgpack.encode(body)
    if not reason:
        found = Receiver.request("set_pose", 7, "", payload)
        assert found == Request("set_pose", 7, Pose(1.5, -2.0, 0.5))
        payload, reason = b"", "unknown_encoding"
    with pytest.raises(DecodeError) as refused:
        Receiver.request("set_pose", 7, "", payload)
    assert refused.value.reason == reason


# Damage.

BODIES = [("cmd/app", twist()), ("cmd/app", stamped(1_700_000_000, 5)),
          ("wheel_cmd/app", joints(1.0, -2.0, 3.5, 0.0))]  # fmt: skip
VALID = [(key, written(body, form)) for key, body in BODIES for form in FORMATS]
NASTY = [
    b"\xed\xa0\x80", b"\xdd\xff\xff\xff\xff", b"\xdb\x7f\xff\xff\xff", b"\x91" * 1500,
    b"[" * 1500, b'{"linear":' * 300, b"\x81\xa6linear" * 400, b"NaN", b"1e999", b"9" * 60,
    b"\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00", b"\xcf" + b"\xff" * 8, b"\\ud800",
    b"\xc9\x7f\xff\xff\xff\x01", struct.pack("<d", math.nan), struct.pack("<d", math.inf),
]  # fmt: skip
damage = st.tuples(
    st.integers(0, 300), st.integers(0, 12), st.binary(max_size=9) | st.sampled_from(NASTY)
)


@given(
    st.sampled_from(VALID),
    st.lists(damage, min_size=1, max_size=3),
    st.sampled_from(["", "application/json", "application/msgpack", "application/cdr"]),
)
@settings(max_examples=100)
def test_a_damaged_payload_is_a_finite_command_or_refused(
    valid: tuple[str, bytes], damages: list[tuple[int, int, bytes]], encoding: str
) -> None:
    key, payload = valid
    for at, lost, more in damages:
        payload = payload[:at] + more + payload[at + lost :]
    try:
        found = RECEIVER.command(arrival(payload, key, encoding=encoding))
    except DecodeError as error:
        msgspec.json.encode(str(error))  # its text is published
        return
    assert math.isfinite(found.twist.linear)
    assert math.isfinite(found.twist.angular)


def test_a_stamp_of_the_largest_second_does_not_make_the_arbiter_raise() -> None:
    largest = RECEIVER.command(arrival(written(stamped(2**31 - 1, 999_999_999), "json")))
    Arbiter().accept(largest, CommandsConfig())
