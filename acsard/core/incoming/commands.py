"""Decodes a sample from the bus into a `Command` or a `Request`, or refuses it with a reason.

A command is refused as a whole, never in part, and a refused command does not refresh the motion.
Reasons are a payload that cannot be decoded or is too big, NaN or infinity in any field that the
daemon reads, a wildcard key, a DELETE, and a sender id that belongs to another certificate.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

from msgspec import UNSET, Struct, UnsetType

from acsard.core.config.settings import JointsConfig
from acsard.core.messages import signature
from acsard.core.messages.encodings import DecodeError, Decoder, decode_cdr, detect
from acsard.core.messages.schema import (
    Header,
    JointState,
    Release,
    SetPose,
    Settings,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.messages.signature import public_name
from acsard.core.messages.topics import COMMANDS
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.attachments import GID_BYTES, unpack
from acsard.core.ros.transports import Transport
from acsard.core.values import NS_PER_S, REST, Command, Pose, Request, Verb, WheelSpeeds
from acsard.core.values import Twist as BodyTwist

BOUND_NS = 60 * NS_PER_S
"""A sender that is silent for longer may come back under another certificate, for example when a
program with a fixed id moves from the robot to a laptop."""

MAX_BOUND = 1024
"""Senders remembered at once. The one that was seen longest ago is forgotten first."""


class Bindings:
    """The certificates of the senders that were seen lately.

    It binds each sender id to the certificate under which the daemon first saw it. The certificate
    is part of a sender's name (`core/messages/signature.py`), so a command under another
    certificate counts as another sender's in any case. But one id under two certificates is a
    mistake or a stolen secret. The daemon therefore refuses the second one for as long as the first
    one speaks.

    Only native keys name a certificate. A sender that commands on a key of ROS is bound to nothing,
    and its name is never that of a native sender.
    """

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, int]] = {}
        """Certificate, "" for the robot's own machine, and time of the last command, by sender."""

    def other(self, sender: str, certificate: str, now_ns: int) -> str | None:
        """Return the certificate that the sender is bound to, or None if it is this one."""
        bound, seen_ns = self._seen.get(sender, (certificate, now_ns))
        if bound != certificate and now_ns - seen_ns <= BOUND_NS:
            return bound
        self._seen.pop(sender, None)
        self._seen[sender] = (certificate, now_ns)
        if len(self._seen) > MAX_BOUND:
            del self._seen[next(iter(self._seen))]
        return None


MAX_COMMAND_BYTES = 4096
"""Limit of a payload. A TwistStamped takes less than 300 bytes as JSON."""

REPLACED_NS = NS_PER_S // 2
"""Zenoh replaces a timestamp that is further ahead of the daemon's clock than this."""

Via = Literal["native"] | Transport
"""The tree of keys on which a sample or query came."""


class Arrival(Struct, frozen=True):
    """A sample as the bus shell took it from Zenoh, with the key below `acsard/<id>/`.

    A sample on a ROS key has the native key that it stands for.
    """

    key: str
    put: bool
    payload: bytes
    encoding: str
    arrived_ns: int
    stamp_ns: int | None
    """Zenoh's timestamp if the sender or a router set it, wall clock in ns."""
    sender: str
    """The id of the Zenoh session that stamped the sample, "" if none did or if a router did."""
    via: Via = "native"
    attachment: bytes = b""
    received_ns: int | None = None
    """Zenoh's timestamp if the daemon's own session set it, because the sample had none or one too
    far ahead of the daemon's clock."""


class _TwistPayload(Struct, frozen=True, forbid_unknown_fields=True):
    """A Twist or a TwistStamped, distinguished by the fields that are set."""

    linear: Vector3 | UnsetType = UNSET
    angular: Vector3 | UnsetType = UNSET
    header: Header | UnsetType = UNSET
    twist: Twist | UnsetType = UNSET


TWIST_CDR_BYTES, STAMPED_CDR_BYTES = 52, 68
"""Size of a Twist in CDR and the least size of a TwistStamped. Often only the size distinguishes
the two."""

TWISTS = ("geometry_msgs/msg/Twist", "acsard.Twist.v1")
STAMPED_TWISTS = ("geometry_msgs/msg/TwistStamped", "acsard.TwistStamped.v1")
"""Type names that an Encoding may carry for the two messages."""

_twists = Decoder(_TwistPayload)
_wheels = Decoder(JointState)
_poses = Decoder(SetPose)
_settings = Decoder(Settings)
_releases = Decoder(Release)

EXAMPLES: dict[Verb, str] = {
    "set_pose": '{"x": 0, "y": 0, "yaw": 0}',
    "set": '{"settings": {"limits.linear_speed": 0.8}}',
    "clear": '{"latch": 1800000000000}',
    "activate": '{"latch": 1800000000000}',
}
"""An example payload of each service that takes one."""

MAY_BE_PLAIN: tuple[Verb, ...] = ("clear", "activate")
"""Services that may also be called without a payload."""


class Receiver:
    """The decoder of commands, by the key on which they came."""

    def __init__(self, joints: JointsConfig, kinematics: Kinematics) -> None:
        self._joints = joints.as_tuple()
        self._kinematics = kinematics
        self._bindings = Bindings()

    def command(self, arrival: Arrival) -> Command:
        """Decode a sample on `cmd/…` or `wheel_cmd/…` into a command; raise `DecodeError`."""
        kind, source, certificate = parts(arrival.key)
        if "*" in arrival.key or "/" in certificate:
            raise DecodeError("wildcard", f"a command needs its exact key, not {arrival.key}")
        if not arrival.put:
            raise DecodeError("not_a_put", "a DELETE is not a command")
        if len(arrival.payload) > MAX_COMMAND_BYTES:
            raise DecodeError("too_big", f"{len(arrival.payload)} bytes")
        said = voice(arrival)
        stamp_ns, clock = said.stamp_ns, said.sender
        if kind == "cmd":
            twist, header, cancelled = self._twist(arrival)
        else:
            twist, header, cancelled = self._wheel_speeds(arrival)
        if header is not None and header.stamp.to_ns() > 0 and not said.steady:
            # The header's stamp comes from another clock than the envelope's, so it gets a name of
            # its own.
            stamp_ns = header.stamp.to_ns()
            clock = f"{clock}, header on {arrival.via}/{arrival.key}"
        if said.signed:
            bound = self._bindings.other(said.signed, certificate, arrival.arrived_ns)
            if bound is not None:
                where = f"certificate {bound}" if bound else "the robot's own machine"
                raise DecodeError(
                    "other_certificate",
                    f"its sender id was first seen under {where}: give each program its own "
                    "sender id",
                )
        ours = arrival.received_ns
        return Command(
            source,
            twist,
            arrival.arrived_ns,
            stamp_ns,
            clock,
            said.sender,
            cancelled,
            said.sequence,
            shared=said.shared,
            ros=arrival.via != "native",
            stamp_replaced=bool(ours and stamp_ns and stamp_ns - ours > REPLACED_NS),
            steady=said.steady,
        )

    def _twist(self, arrival: Arrival) -> tuple[BodyTwist, Header | None, bool]:
        got = _twist_payload(arrival)
        header = None
        linear, angular = got.linear, got.angular
        if not isinstance(got.twist, UnsetType):
            if not (isinstance(linear, UnsetType) and isinstance(angular, UnsetType)):
                raise DecodeError("wrong_shape", "a twist both inside and outside `twist`")
            linear, angular = got.twist.linear, got.twist.angular
            header = None if isinstance(got.header, UnsetType) else got.header
        elif not isinstance(got.header, UnsetType):
            raise DecodeError("wrong_shape", "a header without `twist`: put the twist inside it")
        if isinstance(linear, UnsetType) or isinstance(angular, UnsetType):
            raise DecodeError("wrong_shape", "needs both `linear` and `angular`")
        axes = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        if not all(map(math.isfinite, axes)):
            raise DecodeError("not_finite", "NaN or infinity in the twist")
        twist = BodyTwist(linear.x, angular.z)
        return twist, header, twist == REST and any(axes)

    def _wheel_speeds(self, arrival: Arrival) -> tuple[BodyTwist, Header | None, bool]:
        got = _wheels.decode(arrival.encoding, arrival.payload)
        named, count = [got.name.count(joint) for joint in self._joints], len(got.name)
        if named != [1] * 4 or len(got.velocity) != count:
            raise DecodeError(
                "wrong_wheels", f"needs one velocity for each of {', '.join(self._joints)}"
            )
        places = [got.name.index(joint) for joint in self._joints]
        # Values of other joints, for example of an arm, are not for this daemon.
        velocity, position, effort = (
            [told[place] for place in places] if len(told) == count else told
            for told in (got.velocity, got.position, got.effort)
        )
        if not all(map(math.isfinite, (*velocity, *position, *effort))):
            raise DecodeError("not_finite", "NaN or infinity in the wheel speeds")
        twist = self._kinematics.twist(WheelSpeeds(*velocity))
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            raise DecodeError("not_finite", "wheel speeds too large for a number")
        return twist, got.header, twist == REST and any(velocity)

    @staticmethod
    def request(
        verb: Verb, ticket: int, encoding: str, payload: bytes, asked_ns: int | None = None
    ) -> Request:
        """Decode a service query into a request that is answered by `ticket`.

        Raise `DecodeError` if it is not a valid request.
        """
        if verb not in EXAMPLES or (verb in MAY_BE_PLAIN and not payload):
            return Request(verb, ticket, asked_ns=asked_ns)
        if len(payload) > MAX_COMMAND_BYTES:
            raise DecodeError("too_big", f"over {MAX_COMMAND_BYTES} bytes")
        if verb == "set":
            wished = _settings.decode(encoding, payload).settings
            return Request(verb, ticket, asked_ns=asked_ns, settings=wished)
        if verb in MAY_BE_PLAIN:
            latch = _releases.decode(encoding, payload).latch
            return Request(verb, ticket, asked_ns=asked_ns, latch=latch)
        got = _poses.decode(encoding, payload)
        if (
            not all(map(math.isfinite, (got.x, got.y, got.yaw)))
            or max(abs(got.x), abs(got.y)) > 1e6
        ):
            raise DecodeError("not_finite", "x and y must be within 1000 km, yaw finite")
        return Request(verb, ticket, Pose(got.x, got.y, got.yaw), asked_ns)


class Voice(Struct, frozen=True):
    """The sender of a sample, its stamp and its number, as far as the envelope has them."""

    sender: str
    """The public name: never the id that the sender attached."""
    stamp_ns: int | None = None
    sequence: int | None = None
    shared: bool = False
    """Whether several programs may share this identity."""
    steady: bool = False
    """Whether the clock of the stamps is steady, so that nobody adjusts it."""
    signed: str = ""
    """The public name without the certificate, "" unless a native command carries an id of its
    own."""


# Each command needs the parts of its key twice, and few keys ever command.
@lru_cache(64)
def parts(key: str) -> tuple[str, str, str]:
    """Split the key of a command into kind, source and certificate, "" for none."""
    kind, _, rest = key.partition("/")
    source, _, certificate = rest.partition("/")
    return kind, source, certificate


def voice(arrival: Arrival) -> Voice:
    """Return the sender of a sample, by the first of these that is there.

    On a native key: the attachment (`core/messages/signature.py`), the session that stamped the
    sample, the key. On a key of rmw_zenoh: the GID. On a key of a bridge: the session that stamped
    the sample, the key. All programs that have nothing but a key look like one sender, and so do
    all ROS nodes behind a bridge and all programs that a router stamps. Raises `DecodeError`.

    From here on the sender has only its public name. ROS discovery publishes GIDs, so a program
    that may follow it and put on a key of rmw_zenoh can still claim any GID.
    """
    if arrival.via == "rmw":
        rmw = unpack(arrival.attachment)
        return Voice(_by_gid(rmw.gid), rmw.stamp_ns, rmw.sequence)
    if arrival.via == "bridge":
        name = f"bridge/{public_name(arrival.sender)}" if arrival.sender else _by_key(arrival)
        return Voice(name, arrival.stamp_ns, shared=True)
    told, sender_id, stamp_ns = signature.unpack(arrival.attachment), arrival.sender, None
    if told is not None:
        sender_id, stamp_ns = told.sender, told.stamp
    steady = told is not None and told.steady and told.stamp is not None
    if stamp_ns is None:
        stamp_ns = arrival.stamp_ns
    if not sender_id:
        return Voice(_by_key(arrival), stamp_ns, shared=True)
    kind, _, certificate = parts(arrival.key)
    return Voice(
        public_name(sender_id, certificate),
        stamp_ns,
        None if told is None else told.sequence,
        steady=steady,
        signed=public_name(sender_id) if kind in COMMANDS else "",
    )


def _by_gid(gid: bytes) -> str:
    """Return the public name of a ROS publisher, which no native sender id can have."""
    return f"gid {public_name(gid.hex())}"


def _by_key(arrival: Arrival) -> str:
    return f"{arrival.via}/{arrival.key.partition('/')[2]}"


def sender(arrival: Arrival) -> str:
    """Return the sender's name, also if the attachment of an rmw cannot be read."""
    if arrival.via == "rmw":
        gid = arrival.attachment[-GID_BYTES:]
        # A shorter GID could look like the public name of a sender without a name.
        return _by_gid(gid) if len(gid) == GID_BYTES else ""
    return voice(arrival).sender


def _twist_payload(arrival: Arrival) -> _TwistPayload:
    form = detect(arrival.encoding, arrival.payload)
    if form != "cdr":
        return _twists.decode_as(form, arrival.payload)
    named, size = arrival.encoding.partition(";")[2], len(arrival.payload)
    # Without a type name the size decides. DDS pads to a multiple of four.
    plain, told = named in TWISTS, named in TWISTS + STAMPED_TWISTS
    if plain or (not told and size < TWIST_CDR_BYTES + 4):
        twist = decode_cdr(Twist, arrival.payload)
        return _TwistPayload(linear=twist.linear, angular=twist.angular)
    if not told and size < STAMPED_CDR_BYTES:
        raise DecodeError(
            "wrong_shape", f"{size} bytes of CDR are neither a Twist nor a TwistStamped"
        )
    stamped = decode_cdr(TwistStamped, arrival.payload)
    return _TwistPayload(header=stamped.header, twist=stamped.twist)


def asker(via: Via, attachment: bytes, stamped_by: str = "") -> str:
    """Return a name for the log of the program that called a service or sent a stop.

    The name is the public name of the sender id in the attachment (`core/messages/signature.py`),
    followed by the transport in brackets. The name itself is a claim: Zenoh does not say which
    connection a query came by. The digits behind it are the same for as long as the program keeps
    its secret. A call over rmw_zenoh has the client's GID, which ROS discovery publishes; a bridge
    says nothing. `stamped_by` is the id of the Zenoh session that stamped the sample, "" for none.
    """
    if via == "rmw":
        return f"unnamed (rmw {attachment[-GID_BYTES:].hex()})"
    if via == "bridge":
        return "unnamed (bridge)"
    session = f", session {public_name(stamped_by)}" if stamped_by else ""
    signed = signature.unpack(attachment)
    name = public_name(signed.sender) if signed else "unnamed"
    return f"{name} (native{session})"
