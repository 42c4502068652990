"""Who sent a command, by which clock it is stamped, and whom the daemon names.

The sender comes from the attachment, the session or the key, and is bound to a certificate.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import CommandsConfig, Config
from acsard.core.incoming.commands import (
    BINDING_NS,
    MAX_BINDINGS,
    Arrival,
    Bindings,
    Receiver,
    caller_name,
    claimed_identity,
)
from acsard.core.messages.encodings import DecodeError, Format
from acsard.core.messages.schema import Beat
from acsard.core.messages.signature import (
    HASH_DIGITS,
    MAX_NAME_LENGTH,
    Signature,
    claims_echo,
    public_name,
    unpack,
)
from acsard.core.motion.arbiter import Arbiter
from acsard.core.ros.attachments import Attachment
from acsard.core.values import Command, Echo, Twist, WheelSpeeds
from acsard.daemon.bus.inbox import MAX_ATTACHMENT_BYTES
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

GID = bytes(range(16))
SENT_NS = 1_700_000_000_000_000_000
GID_NAME = f"gid {public_name(GID.hex())}"
Z1, ROUTER = f"session {public_name('z1')}", public_name("router")
JOYSTICK = public_name("joystick/s3cret")
FORMS = (msgspec.json.encode, msgspec.msgpack.encode)


def ours(body: dict[str, Any], form: Format = "json", **changes: Any) -> Arrival:
    return arrival(written(body, form), **changes)


def by_ros(via: str, body: dict[str, Any], **changes: Any) -> Arrival:
    fields: dict[str, Any] = {"key": "cmd/nav", "encoding": "application/cdr", "via": via} | changes
    if via == "rmw":
        fields.setdefault("attachment", Attachment(1, SENT_NS, GID).pack())
    return ours(body, "cdr", **fields)


def signed(**fields: Any) -> bytes:
    return msgspec.msgpack.encode({"sender": "joystick/s3cret"} | fields)


def refusal(incoming: Arrival) -> str:
    with pytest.raises(DecodeError) as caught:
        RECEIVER.command(incoming)
    return caught.value.reason


def test_commands_from_ros_are_those_of_their_source() -> None:
    rmw = RECEIVER.command(by_ros("rmw", twist(), stamp_ns=5, sender="router"))
    assert rmw == Command(
        "nav", Twist(0.5, 0.2), ARRIVED_NS, SENT_NS, GID_NAME, GID_NAME, sequence=1, ros=True
    )
    for via in ("bridge", "rmw"):
        wheels = by_ros(via, joints(6.0, 2.0, 2.0, 6.0), key="wheel_cmd/ros2_control")
        found = RECEIVER.command(wheels)
        assert (found.source, found.twist) == (
            "ros2_control", KINEMATICS.twist(WheelSpeeds(6.0, 2.0, 2.0, 6.0)),
        )  # fmt: skip
        # The controller is not active yet.
        nan = by_ros(via, joints(math.nan, 0.0, 0.0, 0.0), key="wheel_cmd/ros2_control")
        assert refusal(nan) == "not_finite"
        assert refusal(by_ros(via, twist(), key="cmd_*")) == "wildcard"
        assert refusal(by_ros(via, twist(), put=False)) == "not_a_put"
    whole = Attachment(1, SENT_NS, GID).pack()
    for attachment in (b"", b"rqh" + bytes(17), whole + b"x"):
        reason = "bad_attachment" if attachment else "no_attachment"
        assert refusal(by_ros("rmw", twist(), attachment=attachment)) == reason


IDENTITIES: dict[str, tuple[Arrival, str, str, int | None, bool]] = {
    "a key alone": (ours(twist()), "native/app", "native/app", None, True),
    "wheels": (
        ours(joints(1.0, 1.0, 1.0, 1.0), key="wheel_cmd/app"), "native/app", "native/app", None,
        True,
    ),
    "a session that stamps": (ours(twist(), sender="z1", stamp_ns=5), Z1, Z1, 5, True),
    "a header": (
        ours(stamped(12)), "native/app", "native/app, header on native/cmd/app", 12 * 10**9, True,
    ),
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
        ours(twist(), attachment=signed(), sender="z1", stamp_ns=5), JOYSTICK, JOYSTICK, 5, False,
    ),
    "a certificate and our attachment": (
        ours(twist(), key="cmd/app/anna", attachment=signed(stamp=9)), f"{JOYSTICK} [anna]",
        f"{JOYSTICK} [anna]", 9, False,
    ),
    "a certificate and a session": (
        ours(twist(), key="cmd/app/anna", sender="z1", stamp_ns=5), f"{Z1} [anna]", f"{Z1} [anna]",
        5, True,
    ),
    "a certificate": (
        ours(twist(), key="cmd/app/anna"), "native/app/anna", "native/app/anna", None, True,
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
    result = Receiver(Config().joint_names, KINEMATICS).command(sample)
    assert [result.sender, result.clock, result.stamp_ns, result.shared] == expected
    unreadable = claimed_identity(replace(sample, payload=b"hello"))
    assert (unreadable.sender, unreadable.shared) == (result.sender, result.shared)


def test_nothing_public_can_be_sent_to_be_taken_for_another_sender() -> None:
    """The zero of a sender id arms it at once, but the zero of a router's session does not.

    A sender must not get the other treatment by using the session's id, which is not secret.
    """
    for name in ("z1", "session z1", "session/z1", f"{Z1}/z1"):
        attachment = msgspec.msgpack.encode({"sender": name})
        assert RECEIVER.command(ours(twist(), attachment=attachment)).sender != Z1
    half = by_ros("rmw", twist(), attachment=bytes.fromhex(public_name("z1")))
    assert claimed_identity(half).sender == ""
    other = by_ros("rmw", twist(), attachment=Attachment(1, SENT_NS, bytes(16)).pack())
    assert RECEIVER.command(other).sender != GID_NAME


def test_the_clock_of_a_header_is_kept_apart_from_that_of_a_stamping_router() -> None:
    """One clock stamps the messages of all senders behind a router.

    The stamp in a message's header comes from the sender's own clock.
    """
    arbiter, reasons = Arbiter(), []
    for step in range(20):
        now_ns = SENT_NS + step * 50_000_000
        for body in (twist(), stamped(*divmod(now_ns - 10**9, 10**9))):
            sample = replace(
                by_ros("bridge", body, stamp_ns=now_ns, sender="router"),
                arrived_ns=ARRIVED_NS + step * 50_000_000,
            )
            refused = arbiter.accept(RECEIVER.command(sample), CommandsConfig())
            reasons.append("" if refused is None else refused.what)
    assert set(reasons[:10]) == {"unproven"}
    assert set(reasons[12:]) == {""}


@pytest.mark.parametrize(
    ("ahead_ns", "replaced"), [(0, False), (500_000_000, False), (500_000_001, True)]
)
def test_a_stamp_half_a_second_ahead_counts_as_replaced(ahead_ns: int, replaced: bool) -> None:
    attachment = signed(stamp=SENT_NS + ahead_ns)
    result = RECEIVER.command(ours(twist(), attachment=attachment, received_ns=SENT_NS))
    assert (result.stamp_replaced, result.stamp_ns) == (replaced, SENT_NS + ahead_ns)
    for sample in (ours(twist(), attachment=attachment), ours(twist(), received_ns=SENT_NS)):
        assert not RECEIVER.command(sample).stamp_replaced


# the echo of a beat

RUN, BEAT_US = 181_349_028_416_577, 83_214_500_123
BEAT = {"run": RUN, "boot_us": BEAT_US}


@each("form", FORMS)
def test_the_age_of_a_command_with_an_echo_is_its_arrival_minus_the_beat(form: Any) -> None:
    attachment = form({"sender": "joystick/s3cret", "sequence": 12, "echo": BEAT})
    sample = ours(twist(), attachment=attachment, boot_ns=(BEAT_US + 7) * 1000)
    result = Receiver(Config().joint_names, KINEMATICS, RUN).command(sample)
    assert (result.echo, result.age_ns) == (Echo(RUN, BEAT_US * 1000), 7000)
    other_run = Receiver(Config().joint_names, KINEMATICS, RUN + 1).command(sample)
    assert (other_run.echo, other_run.age_ns) == (result.echo, None)


@each("form", FORMS)
@each(
    "echo",
    [BEAT | {"run": str(RUN)}, BEAT | {"run": -1}, BEAT | {"run": 1 << 48},
     BEAT | {"boot_us": 1.5}, BEAT | {"boot_us": True}, BEAT | {"boot_us": 1 << 53},
     {"run": RUN}, [RUN, BEAT_US], BEAT_US, {}],
)  # fmt: skip
def test_a_command_whose_echo_is_not_a_beat_is_refused(form: Any, echo: object) -> None:
    attachment = form({"sender": "joystick/s3cret", "echo": echo})
    with pytest.raises(DecodeError, match="copy the newest message") as raised:
        RECEIVER.command(ours(twist(), attachment=attachment))
    assert raised.value.reason == "bad_echo"
    assert caller_name("native", attachment) == "unnamed (native)"  # a stop still stops
    with pytest.raises(DecodeError, match="beside `sender`"):
        RECEIVER.command(ours(twist(), attachment=form({"echo": BEAT})))


@each("form", FORMS)
def test_an_echo_without_a_number_is_refused_because_a_beat_orders_no_two_commands(
    form: Any,
) -> None:
    attachment = form({"sender": "joystick/s3cret", "echo": BEAT})
    with pytest.raises(DecodeError, match="`sequence`") as raised:
        RECEIVER.command(ours(twist(), attachment=attachment))
    assert raised.value.reason == "bad_echo"


# senders bound to certificates


@pytest.mark.parametrize(("first", "second"), [("", "/anna"), ("/anna", ""), ("/anna", "/ben")])
def test_a_sender_id_under_a_second_certificate_is_refused(first: str, second: str) -> None:
    receiver = Receiver(Config().joint_names, KINEMATICS)
    sample = ours(twist(), key=f"cmd/app{first}", attachment=signed())
    receiver.command(sample)
    with pytest.raises(DecodeError, match="already in use") as raised:
        receiver.command(replace(sample, key=f"cmd/app{second}"))
    assert raised.value.reason == "other_certificate"
    assert receiver.command(sample).sender == claimed_identity(sample).sender
    # Shared senders and those from ROS are not bound.
    bridged = by_ros("bridge", twist(), key=f"cmd/app{second}", attachment=signed())
    assert receiver.command(bridged).sender.startswith("bridge/app")
    for key in ("cmd/app", "cmd/app/anna", "cmd/app/ben"):
        assert receiver.command(ours(twist(), key=key, sender="z1", stamp_ns=5)).shared


def test_the_first_certificate_keeps_a_sender_id_until_it_has_been_silent() -> None:
    bindings = Bindings()
    for at_ns in range(0, 5 * BINDING_NS, BINDING_NS // 2):
        assert bindings.bind("a", "anna", at_ns) is None
        assert bindings.bind("a", "ben", at_ns + 1) == "anna"
        assert bindings.bind("a", "", at_ns + 1) == "anna"
    # Refused commands do not extend it.
    assert bindings.bind("a", "ben", at_ns + BINDING_NS) == "anna"
    assert bindings.bind("a", "ben", at_ns + BINDING_NS + 1) is None
    assert bindings.bind("a", "anna", at_ns + BINDING_NS + 2) == "ben"
    assert bindings.bind("here", "", 0) is None
    assert bindings.bind("here", "anna", 1) == ""


def test_a_flood_of_sender_ids_is_bounded_in_memory_and_active_senders_stay_bound() -> None:
    bindings = Bindings()
    bindings.bind("a", "anna", 0)
    for number in range(4 * MAX_BINDINGS):
        bindings.bind(f"other {number}", "ben", number)
        if number % 100 == 0:
            assert bindings.bind("a", "anna", number) is None
    assert bindings.bind("a", "ben", number) == "anna"
    assert len(bindings._seen) <= MAX_BINDINGS


# signatures and names

WHOLE = {"sender": "joystick-7", "stamp": 1_795_154_884_365_624_370, "sequence": 12}


@each("form", FORMS)
def test_a_signature_is_a_map_with_a_sender(form: Any) -> None:
    for left_out in ((), ("stamp",), ("sequence",), ("stamp", "sequence")):
        fields: dict[str, Any] = {k: v for k, v in WHOLE.items() if k not in left_out}
        expected = Signature("joystick-7", fields.get("stamp"), fields.get("sequence"))
        assert unpack(form(fields)) == expected
    for bad in ({"sender": ""}, {"sender": "x" * 65}, {"stamp": -1}, {"sequence": 1.5}):
        assert unpack(form(WHOLE | bad)) is None
    signature = Signature("laptop/12/ab", 5, 1, echo=Beat((1 << 48) - 1, (1 << 53) - 1))
    assert unpack(signature.pack()) == signature
    nested = b'{"later": ' if form is FORMS[0] else b"\x81\xa5later"
    fill = b"[" if form is FORMS[0] else b"\x91"
    for other in (form({"stamp": 5}), form([1, 2, 3]), nested.ljust(MAX_ATTACHMENT_BYTES, fill),
                  b'{"sender": "a", "stamp": 1180591620717411303424}'):  # fmt: skip
        assert unpack(other) is None


@each(
    ("name", "public"),
    [
        ("joystick", "joystick"), ("laptop/12", "laptop/12"),
        ("mallory (rmw 00)", "mallory ?rmw 00?"), ("a, b", "a? b"),
        ("a\nACSARD_EVENT=stop", "a?ACSARD_EVENT?stop"), ("\x1b[2J", "??2J"),
        ("\u202elaptop", "?laptop"), ("Jürgen", "Jürgen"), ("x" * 50, "x" * MAX_NAME_LENGTH),
    ],
)  # fmt: skip
def test_a_public_name_has_no_secret_and_imitates_no_text(name: str, public: str) -> None:
    digits = hashlib.sha256(f"{name}/s3cret".encode()).hexdigest()[:16]
    assert public_name(f"{name}/s3cret") == f"{public}/{digits}"
    for nameless in ("s3cret", "/s3cret", " /s3cret", "1f2e" * 8):
        assert public_name(nameless) == hashlib.sha256(nameless.encode()).hexdigest()[:16]


def signed_as(name: str) -> bytes:
    return msgspec.json.encode({"sender": name})


@each(
    ("via", "attachment", "session", "name"),
    [
        *(("native", form({"sender": "alice@laptop patrol/s3cret", "sequence": 7}), "",
           "alice@laptop patrol/b8978a0526b85c8d (native)") for form in FORMS),
        *(("native", attachment, "", "unnamed (native)") for attachment in (
            b"", b"joe", b"{}", b'{"sender": 7}', b'{"sender": "\xff"}', b"\x81", signed_as(""))),
        ("native", b"", "1f2e", f"unnamed (native, session {public_name('1f2e')})"),
        ("rmw", bytes(17) + GID, "", f"unnamed (rmw {GID.hex()})"),
        ("bridge", b"rqh" + bytes(17), "", "unnamed (bridge)"),
    ],
)  # fmt: skip
def test_a_caller_is_named_by_its_attachment_its_gid_or_its_session(
    via: Any, attachment: bytes, session: str, name: str
) -> None:
    assert caller_name(via, attachment, session) == name


@given(st.binary(max_size=100) | st.text(min_size=1, max_size=64).map(signed_as))
@example(b"{" + bytes(80))
def test_any_attachment_gives_a_short_printable_name(attachment: bytes) -> None:
    claims_echo(attachment)
    caller = caller_name("native", attachment)
    name = caller.removesuffix(" (native)")
    assert caller == f"{name} (native)"
    assert 1 <= len(name) <= MAX_NAME_LENGTH + 1 + HASH_DIGITS
    assert name.isprintable()
    assert not set(name) & set('(),="[]\n')
    assert public_name(name) != name
