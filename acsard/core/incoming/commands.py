"""Decodes samples and service queries into a `Command`, a `SpeedCap` or a `Request`.

Refused are a DELETE, a key with a wildcard, a payload that is too big or cannot be decoded, NaN or
infinity in a field that is read, and a sender id of another certificate. A refused command does not
refresh the timeout of its source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from acsard.core.messages import signature
from acsard.core.messages.encodings import DecodeError, StrictDecoder, decode_cdr, detect
from acsard.core.messages.keys_and_roles import COMMANDS, SERVICES, SPEED_LIMIT
from acsard.core.messages.refusals import MAX_COMMAND_BYTES, require_size
from acsard.core.messages.schema import (
    MESSAGES,
    Beat,
    Header,
    JointState,
    Message,
    Release,
    SetPose,
    Settings,
    SpeedLimit,
    SwitchOff,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.messages.signature import claims_echo, public_name
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.attachments import GID_BYTES, unpack
from acsard.core.ros.transports import Transport
from acsard.core.values import (
    NS_PER_S,
    NS_PER_US,
    REST,
    Command,
    Echo,
    Ns,
    Pose,
    Request,
    SpeedCap,
    Verb,
    WallNs,
    WheelSpeeds,
    wheels4,
)
from acsard.core.values import Twist as BodyTwist

# Without a command for this time, a sender id may come with another certificate: a program with a
# fixed id may move from the robot to a laptop.
BINDING_NS = 60 * NS_PER_S

MAX_BINDINGS = 1024  # the sender that has been silent longest is forgotten


class Bindings:
    """The certificates to which the sender ids are bound: each to the first one.

    With a second certificate, the id was copied by mistake or stolen, so its commands are refused
    until the first has been silent for `BINDING_NS`. Senders on ROS keys are not bound, because
    these keys have no certificate; their public names differ, so they cannot pretend to be bound.
    """

    def __init__(self) -> None:
        # Certificate ("": on the robot itself) and last command by public name, the oldest first.
        self._seen: dict[str, tuple[str, int]] = {}

    def bind(self, sender: str, certificate: str, now_ns: Ns) -> str | None:
        """Bind a sender (by public name) to a certificate, "" on the robot itself.

        If it is still bound to another one, change nothing and return that one's name.
        """
        bound, seen_ns = self._seen.get(sender, (certificate, now_ns))
        if bound != certificate and now_ns - seen_ns <= BINDING_NS:
            return bound
        self._seen.pop(sender, None)
        self._seen[sender] = (certificate, now_ns)
        if len(self._seen) > MAX_BINDINGS:
            del self._seen[next(iter(self._seen))]
        return None


# Largest lead of a timestamp over the daemon's clock; Zenoh replaces one that is further ahead.
MAX_TIMESTAMP_LEAD_NS = NS_PER_S // 2

Via = Literal["native"] | Transport  # acsard's own keys, or the ROS transport


class Arrival(Struct, frozen=True):
    """A sample as Zenoh delivered it to the daemon."""

    key: str  # below `acsard/<id>/`, for a ROS key that of the same data
    put: bool  # False: a DELETE
    payload: bytes
    encoding: str
    arrived_ns: Ns
    stamp_ns: WallNs | None  # Zenoh's timestamp, if the sender or a router set it
    # Zenoh session of the timestamp (maybe a router's or a bridge's), unless it is the daemon's.
    sender: str
    via: Via = "native"
    attachment: bytes = b""
    # Timestamp of the daemon's own session: there was none, or one too far ahead.
    received_ns: WallNs | None = None
    boot_ns: Ns = 0  # arrival by CLOCK_BOOTTIME


class _TwistPayload(Struct, frozen=True):
    # A Twist (`linear`, `angular`), or a TwistStamped (`header`, `twist`).
    linear: Vector3 | UnsetType = UNSET
    angular: Vector3 | UnsetType = UNSET
    header: Header | UnsetType = UNSET
    twist: Twist | UnsetType = UNSET


# Sizes by which the type is inferred if the Encoding does not name it: exact, and least size.
TWIST_CDR_BYTES, STAMPED_CDR_BYTES = 52, 68

TWISTS = ("geometry_msgs/msg/Twist", "acsard.Twist.v1")
STAMPED_TWISTS = ("geometry_msgs/msg/TwistStamped", "acsard.TwistStamped.v1")

_twists = StrictDecoder(_TwistPayload)
_wheels = StrictDecoder(JointState)
_payloads = {
    verb: StrictDecoder[Message](MESSAGES[service.payload])
    for verb, service in SERVICES.items()
    if service.payload
}


class Receiver:
    """Decodes samples into commands, and service queries into requests."""

    def __init__(self, joints: Sequence[str], kinematics: Kinematics, run: int = 0) -> None:
        # `joints` are those of the driven wheels, and `run` is that of the daemon's beats.
        self._run = run
        self._joints = joints
        self._kinematics = kinematics
        self._bindings = Bindings()

    def command(self, arrival: Arrival) -> Command:
        """Return the command in a sample on `cmd/…` or `wheel_cmd/…`. Raises `DecodeError`."""
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
        if arrival.via == "native" and not identity.signed and claims_echo(arrival.attachment):
            raise DecodeError(
                "bad_echo",
                "the attachment has an echo that is not a beat: copy the newest message of the key "
                "beat into its field `echo`, beside `sender`",
            )
        if identity.echo is not None and identity.sequence is None:
            raise DecodeError(
                "bad_echo",
                "the attachment has an echo, but no `sequence`: number the commands beside it, "
                "because several of them may echo one beat",
            )
        stamp_ns, clock = identity.stamp_ns, identity.sender
        if kind == "cmd":
            twist, header, cancelled = self._twist(arrival)
        else:
            twist, header, cancelled = self._wheel_speeds(arrival)
        if header is not None and header.stamp.to_ns() > 0:
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
        ours, beat = arrival.received_ns, identity.echo
        echo = None if beat is None else Echo(beat.run, beat.boot_us * NS_PER_US)
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
            bridged=arrival.via == "bridge",
            stamp_replaced=bool(ours and stamp_ns and stamp_ns - ours > MAX_TIMESTAMP_LEAD_NS),
            echo=echo,
            age_ns=None
            if echo is None or echo.run != self._run
            else arrival.boot_ns - echo.beat_ns,
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
        if named != [1] * len(named) or len(message.velocity) != count:
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
        twist = self._kinematics.twist(WheelSpeeds(*wheels4(velocity)))
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            raise DecodeError("not_finite", "the wheel speeds are too large to compute a twist")
        return twist, message.header, twist == REST and any(velocity)

    @staticmethod
    def request(
        verb: Verb, ticket: int, encoding: str, payload: bytes, asked_ns: Ns | None = None
    ) -> Request:
        """Return the request in a service query. Raises `DecodeError`.

        The reply repeats `ticket`, and `asked_ns` is the arrival.
        """
        request = Request(verb, ticket, asked_ns=asked_ns)
        if verb not in _payloads or (SERVICES[verb].optional and not payload):
            return request
        require_size(verb, payload)
        match _payloads[verb].decode(encoding, payload):
            case Settings(settings):
                return replace(request, settings=settings)
            case Release(numbers):
                return replace(request, numbers=None if numbers is None else tuple(numbers))
            case SwitchOff(release_port):
                return replace(request, release_port=release_port)
            case SetPose(x, y, yaw):
                if not all(map(math.isfinite, (x, y, yaw))) or max(abs(x), abs(y)) > 1e6:
                    raise DecodeError(
                        "not_finite", "x and y must be within 1000 km, and yaw must be finite"
                    )
                return replace(request, pose=Pose(x, y, yaw))
        return request


_limits = StrictDecoder(SpeedLimit)


def decode_limit(arrival: Arrival, configured: float) -> SpeedCap:
    """Return the speed limit in a sample; % are of `configured`, m/s. Raises `DecodeError`."""
    if not arrival.put:
        raise DecodeError("not_a_put", "a DELETE is not a speed limit: send a PUT")
    if len(arrival.payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for a speed limit")
    message = _limits.decode(arrival.encoding, arrival.payload)
    value = message.speed_limit
    if not math.isfinite(value):
        raise DecodeError("not_finite", "the speed limit is NaN or infinity; send 0.0 to lift it")
    if value < 0.0 or (message.percentage and value > 100.0):
        unit = " %" if message.percentage else " m/s"
        most = " to 100 %" if message.percentage else " m/s or more"
        raise DecodeError("out_of_range", f"{value:g}{unit}: send 0{most}; 0 lifts the limit")
    by = f"{caller_name(arrival.via, arrival.attachment, arrival.sender)} on the key {SPEED_LIMIT}"
    if value == 0.0:
        return SpeedCap(None, by)
    return SpeedCap(value / 100.0 * configured if message.percentage else value, by)


class Identity(Struct, frozen=True):
    """The sender of a sample, with its stamp and its sequence number."""

    sender: str  # public name; the secret id is not kept
    stamp_ns: WallNs | None = None  # in the attachment, or else of Zenoh
    sequence: int | None = None
    shared: bool = False  # several programs may share it
    signed: str = ""  # public name of the sender id of a native command, without the certificate
    echo: Beat | None = None


# The results are cached, because each command needs the parts of its key twice, and commands arrive
# on only a few different keys.
@lru_cache(64)
def parts(key: str) -> tuple[str, str, str]:
    """Return kind, source and certificate of a key such as `cmd/app/laptop`."""
    kind, _, rest = key.partition("/")
    source, _, certificate = rest.partition("/")
    return kind, source, certificate


def identify(arrival: Arrival) -> Identity:
    """Return the identity of a sample's sender. Raises `DecodeError` (rmw without attachment).

    - native key: the sender id in the attachment, else the session of the stamp, else the key.
    - key of rmw_zenoh: the GID.
    - key of a bridge: the session of the stamp, else the key.

    An id or a GID belongs to one program, but a router or a bridge stamps the samples of all its
    programs, so a session or a key may be shared. A GID proves nothing: ROS discovery publishes it.
    """
    if arrival.via == "rmw":
        rmw = unpack(arrival.attachment)
        # Only rmw makes GIDs unique; a bridge of one's own may send zeros for all its programs.
        return Identity(
            publisher_name(rmw.gid), rmw.stamp_ns, rmw.sequence, shared=not any(rmw.gid)
        )
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
        signed=public_name(signed.sender) if kind in COMMANDS else "",
        echo=signed.echo,
    )


def publisher_name(gid: bytes) -> str:
    """Return the public name of a publisher of rmw_zenoh, which no sender on native keys has."""
    return f"gid {public_name(gid.hex())}"


def _by_key(arrival: Arrival) -> str:
    return f"{arrival.via}/{arrival.key.partition('/')[2]}"


def claimed_identity(arrival: Arrival) -> Identity:
    """Return `identify`, even if the attachment is not valid; this raises no error.

    On a key of rmw_zenoh only `sender` is set, and is "" if the attachment is too short for a GID.
    """
    if arrival.via == "rmw":
        gid = arrival.attachment[-GID_BYTES:]
        # A shorter GID could look like the public name of a native sender.
        return Identity(publisher_name(gid) if len(gid) == GID_BYTES else "")
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
    """Return the name in the log of a program that called a service or sent a stop.

    It is the public name of the sender id or "unnamed", with brackets that begin with the
    transport. Without an id they also have the session of the stamp (native) or the GID (rmw). It
    is only a claim: Zenoh does not say on which connection a query arrived.
    """
    if via == "rmw":
        return f"unnamed ({' '.join(filter(None, ('rmw', attachment[-GID_BYTES:].hex())))})"
    if via == "bridge":
        return "unnamed (bridge)"
    signed = signature.unpack(attachment)
    if signed is not None:
        # The session is left out, because only samples have its stamp. With the session, a program
        # would have one name for its samples and another name for its calls.
        return f"{public_name(signed.sender)} (native)"
    session = f", session {public_name(stamped_by)}" if stamped_by else ""
    return f"unnamed (native{session})"
