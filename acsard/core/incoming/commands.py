"""Decodes samples and service queries from the bus into a `Command` or a `Request`.

A sample is refused if it is a DELETE, if its key contains a wildcard, or if its payload is too big
or cannot be decoded. It is also refused if a field that the daemon reads is NaN or infinity, or if
the sender id belongs to another certificate. A refused command does not refresh the timeout of its
source.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from acsard.core.config.settings import JointsConfig
from acsard.core.messages import signature
from acsard.core.messages.encodings import DecodeError, Decoder, decode_cdr, detect
from acsard.core.messages.keys_and_roles import COMMANDS, SERVICES
from acsard.core.messages.schema import (
    MESSAGES,
    Header,
    JointState,
    Message,
    Release,
    SetPose,
    Settings,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.messages.signature import public_name
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.attachments import GID_BYTES, unpack
from acsard.core.ros.transports import Transport
from acsard.core.values import NS_PER_S, REST, Command, Pose, Request, Verb, WheelSpeeds
from acsard.core.values import Twist as BodyTwist

BINDING_NS = 60 * NS_PER_S
"""Time without a command after which a sender id may be used with another certificate, ns. For
example, a program with a fixed id may move from the robot to a laptop."""

MAX_BINDINGS = 1024
"""Largest number of sender ids for which the daemon remembers the certificate. If there are more,
the daemon forgets the sender that has sent no command for the longest time."""


class Bindings:
    """The certificates to which the sender ids are bound.

    A sender id is bound to the certificate with which the daemon first received it. If an id
    arrives with a second certificate, a user copied the id by mistake, or somebody stole its
    secret. The daemon then refuses the commands with the second certificate. It accepts them only
    when no command with the first certificate has arrived for `BINDING_NS`.

    Senders on ROS keys are not bound, because ROS keys do not contain the name of a certificate. A
    sender on a ROS key cannot pretend to be a bound sender, because the public names of the two
    kinds differ.
    """

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, int]] = {}
        """Maps the public name of each sender id to a pair: the certificate name of the sender, and
        the monotonic time of its last command, ns. The certificate name is "" for a program on the
        robot itself. The oldest command is first."""

    def bind(self, sender: str, certificate: str, now_ns: int) -> str | None:
        """Bind a sender id to a certificate, and return None.

        If the id is still bound to another certificate, change nothing and return the name of the
        other certificate. `sender` is the public name of the id. `certificate` is the common name
        of the certificate, or "" for a program on the robot itself. `now_ns` is the present
        monotonic time, ns.
        """
        bound, seen_ns = self._seen.get(sender, (certificate, now_ns))
        if bound != certificate and now_ns - seen_ns <= BINDING_NS:
            return bound
        self._seen.pop(sender, None)
        self._seen[sender] = (certificate, now_ns)
        if len(self._seen) > MAX_BINDINGS:
            del self._seen[next(iter(self._seen))]
        return None


MAX_COMMAND_BYTES = 4096
"""Largest payload of a command or a service query, bytes. A TwistStamped in JSON is shorter than
300 bytes."""

MAX_TIMESTAMP_LEAD_NS = NS_PER_S // 2
"""Largest time by which a timestamp may be ahead of the daemon's clock, ns. Zenoh replaces a
timestamp that is further ahead."""

Via = Literal["native"] | Transport
"""The kind of key on which a sample or query arrived: "native" for acsard's own keys, otherwise the
name of the ROS transport."""


class Arrival(Struct, frozen=True):
    """A sample as Zenoh delivered it to the daemon."""

    key: str
    """The key below `acsard/<id>/`. For a sample on a ROS key, it is acsard's own key for the same
    data."""
    put: bool
    """True for a PUT, false for a DELETE."""
    payload: bytes
    encoding: str
    arrived_ns: int
    """Monotonic time of arrival, ns."""
    stamp_ns: int | None
    """Zenoh's timestamp, wall-clock ns since 1970. None if neither the sender nor a router set
    it."""
    sender: str
    """Id of the Zenoh session that set the sample's timestamp. This may be the session of the
    sender, of a router or of a bridge. The id is "" if the sample arrived without a timestamp, or
    if the daemon's own session replaced the timestamp."""
    via: Via = "native"
    attachment: bytes = b""
    received_ns: int | None = None
    """Timestamp that the daemon's own Zenoh session set, wall-clock ns since 1970; otherwise None.
    The session sets a timestamp if the sample arrives without a timestamp, or with a timestamp that
    is too far ahead of the daemon's clock."""


class _TwistPayload(Struct, frozen=True, forbid_unknown_fields=True):
    """A Twist, with `linear` and `angular`, or a TwistStamped, with `header` and `twist`."""

    linear: Vector3 | UnsetType = UNSET
    angular: Vector3 | UnsetType = UNSET
    header: Header | UnsetType = UNSET
    twist: Twist | UnsetType = UNSET


TWIST_CDR_BYTES, STAMPED_CDR_BYTES = 52, 68
"""Exact size of a Twist in CDR, and smallest size of a TwistStamped in CDR, bytes. If the Zenoh
Encoding does not name the type, the daemon infers the type from the size of the payload."""

TWISTS = ("geometry_msgs/msg/Twist", "acsard.Twist.v1")
STAMPED_TWISTS = ("geometry_msgs/msg/TwistStamped", "acsard.TwistStamped.v1")

_twists = Decoder(_TwistPayload)
_wheels = Decoder(JointState)
_payloads = {
    verb: Decoder[Message](MESSAGES[service.payload])
    for verb, service in SERVICES.items()
    if service.payload
}


class Receiver:
    """Decodes samples into commands, and service queries into requests."""

    def __init__(self, joints: JointsConfig, kinematics: Kinematics) -> None:
        self._joints = joints.as_tuple()
        self._kinematics = kinematics
        self._bindings = Bindings()

    def command(self, arrival: Arrival) -> Command:
        """Return the command in a sample on `cmd/…` or `wheel_cmd/…`.

        Raises `DecodeError` if the sample is not a valid command.
        """
        kind, source, certificate = parts(arrival.key)
        if "*" in arrival.key or "/" in certificate:
            raise DecodeError(
                "wildcard",
                f"a command needs an exact key such as cmd/app, but came on {arrival.key}",
            )
        if not arrival.put:
            raise DecodeError("not_a_put", "a DELETE is not a command: send a PUT")
        if len(arrival.payload) > MAX_COMMAND_BYTES:
            raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for a command")
        identity = identify(arrival)
        stamp_ns, clock = identity.stamp_ns, identity.sender
        if kind == "cmd":
            twist, header, cancelled = self._twist(arrival)
        else:
            twist, header, cancelled = self._wheel_speeds(arrival)
        if header is not None and header.stamp.to_ns() > 0 and not identity.steady:
            # The stamps of the header and of the attachment may come from different clocks, so the
            # clock of the header gets its own name.
            stamp_ns = header.stamp.to_ns()
            clock = f"{clock}, header on {arrival.via}/{arrival.key}"
        if identity.signed:
            bound = self._bindings.bind(identity.signed, certificate, arrival.arrived_ns)
            if bound is not None:
                where = f"with the certificate {bound}" if bound else "on the robot's own machine"
                raise DecodeError(
                    "other_certificate",
                    f"this sender id is already in use {where}: give each program its own "
                    "sender id",
                )
        ours = arrival.received_ns
        return Command(
            source,
            twist,
            arrival.arrived_ns,
            stamp_ns,
            clock,
            identity.sender,
            cancelled,
            identity.sequence,
            shared=identity.shared,
            ros=arrival.via != "native",
            stamp_replaced=bool(ours and stamp_ns and stamp_ns - ours > MAX_TIMESTAMP_LEAD_NS),
            steady=identity.steady,
        )

    def _twist(self, arrival: Arrival) -> tuple[BodyTwist, Header | None, bool]:
        message = _twist_payload(arrival)
        header = None
        linear, angular = message.linear, message.angular
        if not isinstance(message.twist, UnsetType):
            if not (isinstance(linear, UnsetType) and isinstance(angular, UnsetType)):
                raise DecodeError(
                    "wrong_shape",
                    "the message has velocities both inside and outside `twist`: send them in one "
                    "place only",
                )
            linear, angular = message.twist.linear, message.twist.angular
            header = None if isinstance(message.header, UnsetType) else message.header
        elif not isinstance(message.header, UnsetType):
            raise DecodeError(
                "wrong_shape",
                "the message has `header` but no `twist`: put `linear` and `angular` into `twist`",
            )
        if isinstance(linear, UnsetType) or isinstance(angular, UnsetType):
            raise DecodeError("wrong_shape", "the message needs both `linear` and `angular`")
        axes = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        if not all(map(math.isfinite, axes)):
            raise DecodeError("not_finite", "the twist contains NaN or infinity")
        twist = BodyTwist(linear.x, angular.z)
        return twist, header, twist == REST and any(axes)

    def _wheel_speeds(self, arrival: Arrival) -> tuple[BodyTwist, Header | None, bool]:
        message = _wheels.decode(arrival.encoding, arrival.payload)
        named, count = [message.name.count(joint) for joint in self._joints], len(message.name)
        if named != [1] * 4 or len(message.velocity) != count:
            raise DecodeError(
                "wrong_wheels",
                f"the message needs one velocity for each of {', '.join(self._joints)}",
            )
        places = [message.name.index(joint) for joint in self._joints]
        # Ignore the values of other joints, for example those of an arm.
        velocity, position, effort = (
            [values[place] for place in places] if len(values) == count else values
            for values in (message.velocity, message.position, message.effort)
        )
        if not all(map(math.isfinite, (*velocity, *position, *effort))):
            raise DecodeError("not_finite", "the wheel speeds contain NaN or infinity")
        twist = self._kinematics.twist(WheelSpeeds(*velocity))
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            raise DecodeError("not_finite", "the wheel speeds are too large to compute a twist")
        return twist, message.header, twist == REST and any(velocity)

    @staticmethod
    def request(
        verb: Verb, ticket: int, encoding: str, payload: bytes, asked_ns: int | None = None
    ) -> Request:
        """Return the request in a service query. Raise `DecodeError` if the payload is not valid.

        `verb` is the called service. `ticket` is the number of the query, which the reply repeats.
        `encoding` is the Zenoh Encoding of `payload`. `asked_ns` is the monotonic time at which the
        query arrived, ns.
        """
        request = Request(verb, ticket, asked_ns=asked_ns)
        if verb not in _payloads or (SERVICES[verb].optional and not payload):
            return request
        require_size(verb, payload)
        match _payloads[verb].decode(encoding, payload):
            case Settings(settings):
                return replace(request, settings=settings)
            case Release(latch):
                return replace(request, latch=latch)
            case SetPose(x, y, yaw):
                if not all(map(math.isfinite, (x, y, yaw))) or max(abs(x), abs(y)) > 1e6:
                    raise DecodeError(
                        "not_finite", "x and y must be within 1000 km, and yaw must be finite"
                    )
                return replace(request, pose=Pose(x, y, yaw))
        return request


def require_size(verb: Verb, payload: bytes) -> None:
    """Raise `DecodeError` if this payload is too large for a call of the service `verb`.

    A service that needs no payload ignores a payload of any size.
    """
    if verb in _payloads and len(payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"the payload has over {MAX_COMMAND_BYTES} bytes")


class Identity(Struct, frozen=True):
    """The sender of a sample, with the stamp and the sequence number of the sample if known."""

    sender: str
    """The public name of the sender. The secret id is not kept."""
    stamp_ns: int | None = None
    """Time of sending by the wall clock, ns since 1970; None if unknown. It is the stamp in the
    attachment, or else the timestamp of Zenoh."""
    sequence: int | None = None
    shared: bool = False
    """Whether several programs may share this identity."""
    steady: bool = False
    """Whether the sender states that the clock of its stamps is never adjusted."""
    signed: str = ""
    """The public name of the sender id, without the name of the TLS certificate. It is "" if the
    sample has no sender id, if it is not a command, or if it arrived on a ROS key."""


# The results are cached, because each command needs the parts of its key twice, and commands arrive
# on only a few different keys.
@lru_cache(64)
def parts(key: str) -> tuple[str, str, str]:
    """Return the kind, the source and the certificate name in a command key.

    For `cmd/app` they are "cmd", "app" and "". For `cmd/app/laptop` they are "cmd", "app" and
    "laptop".
    """
    kind, _, rest = key.partition("/")
    source, _, certificate = rest.partition("/")
    return kind, source, certificate


def identify(arrival: Arrival) -> Identity:
    """Return the identity of a sample's sender.

    The identity depends on the key of the sample:

    - a native key (one of acsard's own keys): the sender id in the attachment. If there is none,
      the identity is the session that stamped the sample, or else the key.
    - a key of rmw_zenoh: the GID.
    - a key of a bridge: the session that stamped the sample, or else the key.

    A sender id or a GID belongs to one program. Several programs may share a session or a key: a
    router or a bridge stamps the samples of all programs that connect through it. The daemon cannot
    tell the session of a router from the session of a program.

    A GID does not prove the identity. ROS discovery publishes the GIDs, so a program that may put
    on a key of rmw_zenoh can claim any GID.

    Raises `DecodeError` if a sample on a key of rmw_zenoh has no valid attachment.
    """
    if arrival.via == "rmw":
        rmw = unpack(arrival.attachment)
        return Identity(_by_gid(rmw.gid), rmw.stamp_ns, rmw.sequence)
    if arrival.via == "bridge":
        name = f"bridge/{public_name(arrival.sender)}" if arrival.sender else _by_key(arrival)
        return Identity(name, arrival.stamp_ns, shared=True)
    kind, _, certificate = parts(arrival.key)
    signed = signature.unpack(arrival.attachment)
    if signed is None:
        name = _by_key(arrival)
        if arrival.sender:
            # No sender id has such a public name: in public names, "/" separates name and hash.
            name = f"session {public_name(arrival.sender, certificate)}"
        return Identity(name, arrival.stamp_ns, shared=True)
    return Identity(
        public_name(signed.sender, certificate),
        arrival.stamp_ns if signed.stamp is None else signed.stamp,
        signed.sequence,
        steady=signed.steady and signed.stamp is not None,
        signed=public_name(signed.sender) if kind in COMMANDS else "",
    )


def _by_gid(gid: bytes) -> str:
    """Return the public name of a ROS publisher.

    No sender on acsard's own keys has the same public name.
    """
    return f"gid {public_name(gid.hex())}"


def _by_key(arrival: Arrival) -> str:
    return f"{arrival.via}/{arrival.key.partition('/')[2]}"


def claimed_identity(arrival: Arrival) -> Identity:
    """Return the identity of a sample's sender, even if the attachment of the sample is not valid.

    The result equals that of `identify`, except for a sample on a key of rmw_zenoh. For such a
    sample, only the field `sender` is set. It is "" if the attachment is too short for a GID. The
    function never raises an error.
    """
    if arrival.via == "rmw":
        gid = arrival.attachment[-GID_BYTES:]
        # A shorter GID could look like the public name of a native sender.
        return Identity(_by_gid(gid) if len(gid) == GID_BYTES else "")
    return identify(arrival)


def _twist_payload(arrival: Arrival) -> _TwistPayload:
    form = detect(arrival.encoding, arrival.payload)
    if form != "cdr":
        return _twists.decode_as(form, arrival.payload)
    named, size = arrival.encoding.partition(";")[2], len(arrival.payload)
    # If the Encoding names no type, the size shows the type. DDS pads a payload to a multiple of
    # four bytes.
    plain, known = named in TWISTS, named in TWISTS + STAMPED_TWISTS
    if plain or (not known and size < TWIST_CDR_BYTES + 4):
        twist = decode_cdr(Twist, arrival.payload)
        return _TwistPayload(linear=twist.linear, angular=twist.angular)
    if not known and size < STAMPED_CDR_BYTES:
        raise DecodeError(
            "wrong_shape", f"{size} bytes of CDR are neither a Twist nor a TwistStamped"
        )
    stamped = decode_cdr(TwistStamped, arrival.payload)
    return _TwistPayload(header=stamped.header, twist=stamped.twist)


def caller_name(via: Via, attachment: bytes, stamped_by: str = "") -> str:
    """Return the name that the log shows for a program that called a service or sent a stop.

    The name has a suffix in brackets, which begins with the transport `via`:

    - native: the public name of the sender id in `attachment`. Without a sender id the name is
      "unnamed". The brackets then also contain the public name of `stamped_by`, the Zenoh session
      that stamped the sample, if `stamped_by` is not "".
    - rmw: "unnamed". The brackets also contain the GID of the client.
    - bridge: "unnamed".

    The name is only a claim of the program: Zenoh does not say on which connection a query arrived.
    """
    if via == "rmw":
        return f"unnamed (rmw {attachment[-GID_BYTES:].hex()})"
    if via == "bridge":
        return "unnamed (bridge)"
    signed = signature.unpack(attachment)
    if signed is not None:
        # The session is left out, because only samples have its stamp. With the session, a program
        # would have one name for its samples and another name for its calls.
        return f"{public_name(signed.sender)} (native)"
    session = f", session {public_name(stamped_by)}" if stamped_by else ""
    return f"unnamed (native{session})"
