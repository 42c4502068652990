"""The published structs, shaped and named like their ROS 2 messages, a unit beside each field.

One schema, several encodings: a field means the same thing as msgpack and as JSON. Incoming
structs refuse unknown fields, so a misspelt axis is an error and not a standstill.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, get_args

from msgspec import Meta, Struct

from acsard.drive.modes import Mode
from acsard.mcu.link_state import State
from acsard.messages.topics import Direction
from acsard.values import NS_PER_S, ROLES, EventName, GyroDoes, Level, Plain

# What `cdr.py` has to know: the width of an int in CDR, the length of an array.
Seconds = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1, extra={"cdr": "i"})]
Nanoseconds = Annotated[int, Meta(ge=0, lt=NS_PER_S, extra={"cdr": "I"})]
Byte = Annotated[int, Meta(ge=0, le=255, extra={"cdr": "B"})]
Covariance = Annotated[list[float], Meta(min_length=36, max_length=36)]

Covariance3 = Annotated[list[float], Meta(min_length=9, max_length=9)]

LatchNumber = Annotated[int, Meta(ge=0, lt=1 << 53)]
"""Number of a latch, small enough for a JavaScript number."""

FEW = Meta(max_length=64)
"""More joints than any robot of ours; what a stranger sends must not take long to refuse."""


def one_of(values: Iterable[object]) -> Meta:
    """Says in the JSON Schema which values there are; who decodes does not refuse a later one."""
    return Meta(extra_json_schema={"enum": list(values)})


class Message(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every struct on the bus."""


class Time(Message, frozen=True):
    """Wall-clock time since 1970-01-01 UTC; `sec` is an int32 as in ROS."""

    sec: Seconds = 0
    nanosec: Nanoseconds = 0

    @classmethod
    def from_ns(cls, wall_ns: int) -> Time:
        """The time `wall_ns` nanoseconds after 1970; held to what an int32 can tell (1901-2038)."""
        sec, nanosec = divmod(wall_ns, NS_PER_S)
        return cls(max(-(2**31), min(2**31 - 1, sec)), nanosec)

    def to_ns(self) -> int:
        """Nanoseconds since 1970."""
        return self.sec * NS_PER_S + self.nanosec


class Header(Message, frozen=True):
    """When the data was sampled and in which frame it is."""

    stamp: Time = Time()
    frame_id: str = ""


class Vector3(Message, frozen=True):
    """Three components; the unit is that of the field it fills."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(Message, frozen=True):
    """A rotation as unit quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Twist(Message, frozen=True):
    """Velocity: `linear` m/s, `angular` rad/s. A planar base follows linear.x and angular.z."""

    linear: Vector3
    angular: Vector3


class TwistStamped(Message, frozen=True):
    """A twist with the time it was meant at."""

    header: Header
    twist: Twist


class Pose(Message, frozen=True):
    """`position` m and `orientation`."""

    position: Vector3
    orientation: Quaternion


class PoseStamped(Message, frozen=True):
    """A pose in `header.frame_id` at the time of `header.stamp`."""

    header: Header
    pose: Pose


class PoseWithCovariance(Message, frozen=True):
    """A pose and its 6x6 covariance, row major, (x, y, z, roll, pitch, yaw), m and rad."""

    pose: Pose
    covariance: Covariance


class TwistWithCovariance(Message, frozen=True):
    """A twist and its 6x6 covariance, row major, m/s and rad/s."""

    twist: Twist
    covariance: Covariance


class Odometry(Message, frozen=True):
    """Pose of `child_frame_id` in `header.frame_id`, twist in `child_frame_id`."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


class Transform(Message, frozen=True):
    """`translation` m and `rotation`."""

    translation: Vector3
    rotation: Quaternion


class TransformStamped(Message, frozen=True):
    """Where `child_frame_id` is in `header.frame_id`."""

    header: Header
    child_frame_id: str
    transform: Transform


class TFMessage(Message, frozen=True):
    """A list of transforms."""

    transforms: list[TransformStamped]


class JointState(Message, frozen=True):
    """Per joint `name`: `position` rad (continuous), `velocity` rad/s, `effort` N m (unused)."""

    header: Header = Header()
    name: Annotated[list[str], FEW] = []
    position: Annotated[list[float], FEW] = []
    velocity: Annotated[list[float], FEW] = []
    effort: Annotated[list[float], FEW] = []


class Imu(Message, frozen=True):
    """An inertial measurement in `header.frame_id`: rad/s and m/s2, each with its 3x3 covariance.

    A covariance that begins with -1 says that this is not measured.
    """

    header: Header
    orientation: Quaternion
    orientation_covariance: Covariance3
    angular_velocity: Vector3
    angular_velocity_covariance: Covariance3
    linear_acceleration: Vector3
    linear_acceleration_covariance: Covariance3


class SourceState(Message, frozen=True):
    """One commander: seconds since its last accepted command (null: none) and what it waits for."""

    name: str
    priority: int
    age: float | None
    waits_for: str


class Spread(Message, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, us."""

    count: int
    p50: float
    p99: float
    max: float


class Figure(Message, frozen=True):
    """A duration that the daemon measures of itself."""

    since_start: Spread
    last_minute: Spread


class RobotState(Message, frozen=True):
    """The compact summary: mode and why, pose (m, rad), twist (m/s, rad/s), wheels (rad/s).

    While no feedback comes, no speed is known: `linear` and `angular` are null, `wheels` is empty.
    """

    stamp: Time
    mode: Annotated[str, one_of(mode.value for mode in Mode)]
    reason: str
    x: float
    y: float
    yaw: float
    linear: float | None
    angular: float | None
    wheels: list[float]
    """Measured speeds in the order front right, front left, rear left, rear right."""
    link: Annotated[str, one_of(get_args(State))]
    source: str
    sources: list[SourceState]
    refused: str
    """The last command that was refused and why; empty when none was."""
    counters: dict[str, int]
    certificate: str = ""
    """How long the bus's TLS certificate is valid, in words; empty without TLS."""
    figures: dict[str, Figure] = {}
    """How fast it is, by the names in `runtime/figures.py`; at most a second old."""
    gyro: Annotated[str, one_of(get_args(GyroDoes))] = "off"
    """What the gyro does for odometry: `values.GyroDoes`."""
    encoders: list[int] = []
    """Counts per wheel turn found in the speeds, in the order of `wheels`; 0: they show none."""
    doubt: str = ""
    """The wheel that is left out of the pose, or the side that slips, in words; empty else."""
    sender: str = ""
    """The public name of the sender of `source` that is followed."""
    track: str = ""
    """The effective track over the wheel separation, as the gyro teaches it and as configured, and
    which is in use, in words; empty until one is learned."""
    recording: str = ""
    """Why nothing is recorded just now, though it is asked for, in words; empty else."""
    latch: LatchNumber = 0
    """Number of the fault, else of the stop, else of "inactive"; 0 while none is latched."""
    latch_file: str = ""
    """Why a stop would not survive a restart, in words; empty if it would, or in the simulator."""
    feedback_age: float | None = None
    """Seconds since the last good line of the microcontroller; null before the first one."""


class DoorState(Message, frozen=True):
    """What the door to the network tells the daemon."""

    opened: Annotated[int, Meta(ge=0, lt=1 << 62)]
    """When, in ns of the machine's monotonic clock: another number is another door."""
    connections: Annotated[int, Meta(ge=0, lt=1 << 16)]
    """From outside, now."""
    crowded: Annotated[int, Meta(ge=0, lt=1 << 31)]
    """Looks, four a second, at which all connections were taken."""
    certificate_ends: Annotated[int, Meta(ge=0, lt=1 << 62)] = 0
    """Wall-clock time in ns; 0 where the library to read it is missing."""


class KeyValue(Message, frozen=True):
    """One diagnostic figure, as text."""

    key: str
    value: str


class DiagnosticStatus(Message, frozen=True):
    """`level` 0 ok, 1 warning, 2 error, 3 stale."""

    level: Annotated[Byte, one_of(range(4))]
    name: str
    message: str
    hardware_id: str
    values: list[KeyValue]


class DiagnosticArray(Message, frozen=True):
    """The state of every part of the robot at one time."""

    header: Header
    status: list[DiagnosticStatus]


class Happening(Message, frozen=True):
    """An event as the log has it."""

    stamp: Time
    name: Annotated[str, one_of(get_args(EventName))]
    level: Annotated[str, one_of(get_args(Level))]
    text: str
    by: str
    """Who asked, sent or commands; empty when that is nobody."""
    count: int
    """How many times: since the last of this name, or of what goes on and on, without a minute's
    rest, since it began."""


class Events(Message, frozen=True):
    """The last events, oldest first; what goes on and on is one, as of the last time."""

    stamp: Time
    """When the last of them was."""
    total: int
    """How many there were since the start. One that goes on counts each time, and is the last then:
    new are, of so many as the total has grown by, those that differ from what was known."""
    events: list[Happening]


class ServiceReply(Message, frozen=True):
    """Did the service do it, and what happened or what to do instead."""

    success: bool
    message: str


class SetPose(Message, frozen=True):
    """Where base_link is to be in odom: m, m, rad."""

    x: float
    y: float
    yaw: float


class Release(Message, frozen=True):
    """The latch that `clear` or `activate` releases, by `RobotState.latch`; null names none."""

    latch: LatchNumber | None = None


class Settings(Message, frozen=True):
    """What is to be set: values by their keys in `acsard.toml`, tables and key joined by dots."""

    settings: Annotated[dict[str, Plain], FEW]


class Info(Message, frozen=True):
    """Who is this daemon."""

    id: str
    version: str
    pid: int
    port: str
    simulated: bool
    rate: float
    """Control rate, Hz."""
    listen: list[str]
    connect: list[str]


class HardwareInterface(Message, frozen=True):
    """One line of `ros2 control list_hardware_interfaces`."""

    name: str
    kind: Annotated[str, one_of(("command", "state"))]
    unit: Annotated[str, one_of(("rad", "rad/s"))]
    available: bool
    claimed: bool
    """A command interface is claimed while a source drives."""


class Interfaces(Message, frozen=True):
    """The command and state interfaces of the base."""

    interfaces: list[HardwareInterface]


class TopicInfo(Message, frozen=True):
    """One row of the topic table."""

    key: str
    direction: Annotated[str, one_of(get_args(Direction))]
    type: str
    rate: str
    note: str


class Topics(Message, frozen=True):
    """The topic table of this daemon, with its full keys."""

    topics: list[TopicInfo]


class WhoAmI(Message, frozen=True):
    """Who asks, as the daemon sees it."""

    role: Annotated[str, one_of(ROLES)]
    """At least this, by the access rules."""
    sender: str
    """The caller's public name and its transport, as in the log."""


MESSAGES: dict[str, type[Message]] = {
    cls.__name__: cls
    for cls in (
        Odometry,
        TFMessage,
        JointState,
        PoseStamped,
        Imu,
        Twist,
        TwistStamped,
        RobotState,
        DoorState,
        DiagnosticArray,
        Events,
        ServiceReply,
        SetPose,
        Release,
        Settings,
        Info,
        Interfaces,
        Topics,
        WhoAmI,
    )
}
"""Every type that crosses the bus by itself, by name: what `schema/<Type>` answers for."""
