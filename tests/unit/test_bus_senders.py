"""Who sent a command, by which clock it is stamped, and whom the daemon names.

The sender comes from the attachment, the session or the key, and is bound to a certificate.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import CommandsConfig, JointsConfig
from acsard.core.incoming.commands import (
    BINDING_NS,
    MAX_BINDINGS,
    Arrival,
    Bindings,
    Receiver,
    caller_name,
    claimed_identity,
)
from acsard.core.messages.encodings import FORMATS, DecodeError, Format
from acsard.core.messages.signature import HASH_DIGITS, MAX_NAME_LENGTH, public_name
from acsard.core.motion.arbiter import Arbiter
from acsard.core.ros.attachments import Attachment
from acsard.core.values import Command, Echo, Twist, WheelSpeeds
from tests.each import each
from tests.unit.test_bus_commands import (
    ARRIVED_NS,
    KINEMATICS,
    RECEIVER,
    arrival,
    joints,
    stamped,
    twist,
    written,
)

HEADER_S = "native/app, header on native/cmd/app"
"""Name of the clock behind a header stamp when nothing else identifies the sender."""


def command(body: dict[str, Any], form: Format = "msgpack", **changes: Any) -> Command:
    return RECEIVER.command(arrival(written(body, form), **changes))


def wheels(body: dict[str, Any], form: Format = "msgpack", **changes: Any) -> Command:
    return command(body, form, key="wheel_cmd/app", **changes)


def refusal(incoming: Arrival) -> str:
    with pytest.raises(DecodeError) as caught:
        RECEIVER.command(incoming)
    return caught.value.reason


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


def test_wheel_commands_are_stamped_in_the_same_way_as_twists() -> None:
    body = joints(1.0, 1.0, 1.0, 1.0)
    header = {"header": {"stamp": {"sec": 9, "nanosec": 1}}}
    assert wheels(body | header, stamp_ns=5).stamp_ns == 9_000_000_001
    assert wheels(body, stamp_ns=5).stamp_ns == 5


def test_the_age_counts_from_the_arrival_and_not_from_the_stamp() -> None:
    assert command(stamped(1), stamp_ns=2).arrived_ns == ARRIVED_NS


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
        for body in (twist(), slow):
            sample = replace(
                by_ros("bridge", body, key="cmd/nav", stamp_ns=now_ns, sender="router"),
                arrived_ns=at_ns,
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
