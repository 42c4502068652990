"""The types of the messages on the bus, with the unit of each field.

If ROS 2 has a corresponding type, the struct has the same name and fields. A field means the same
in msgpack, JSON and CDR. A client ignores fields that it does not know, and a field that a later
version adds has a default, so that clients and daemons of different versions understand each other.
The daemon refuses unknown fields (`strict_types.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, get_args

from msgspec import Meta, Struct, field

from acsard.core.codes import Code, StateCode, received_text
from acsard.core.link.link_state import LinkState
from acsard.core.messages.certificate_expiry import Expiry
from acsard.core.messages.keys_and_roles import Direction
from acsard.core.motion.modes import Mode
from acsard.core.tables.pose_codes import PoseCode
from acsard.core.tables.sender_codes import WaitCode
from acsard.core.values import (
    NS_PER_S,
    ROLES,
    BatteryLevel,
    CauseKind,
    EstopState,
    EventName,
    GyroDoes,
    Level,
    Plain,
)

# These annotations tell `cdr.py` the width of a number and the fixed length of an array.
StampSeconds = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1, extra={"cdr": "i"})]
Nanoseconds = Annotated[int, Meta(ge=0, lt=NS_PER_S, extra={"cdr": "I"})]
Byte = Annotated[int, Meta(ge=0, le=255, extra={"cdr": "B"})]
Float32 = Annotated[float, Meta(extra={"cdr": "f"})]
Covariance = Annotated[list[float], Meta(min_length=36, max_length=36)]

Covariance3 = Annotated[list[float], Meta(min_length=9, max_length=9)]

UNKNOWN = [0.0] * 9  # a covariance in sensor_msgs/Imu

CauseNumber = Annotated[int, Meta(ge=0, lt=1 << 53)]
"""Number of a cause. It is below 2^53, so JavaScript represents it exactly."""

MAX_64_ITEMS = Meta(max_length=64)
"""Limit of 64 items for a list or a map, so that a huge message is refused quickly. No robot has
more than 64 joints."""


def one_of(values: Iterable[object]) -> Meta:
    """Return an annotation that lists the expected values of a field in its JSON Schema.

    Decoding also accepts other values, because a later version may send them.
    """
    return Meta(extra_json_schema={"enum": list(values)})


class Message(Struct, frozen=True):
    """Base class of all messages on the bus and of their parts."""


class Time(Message, frozen=True):
    """Wall-clock time since 1970-01-01 UTC. `sec` is an int32 as in ROS."""

    sec: StampSeconds = 0
    nanosec: Nanoseconds = 0

    @classmethod
    def from_ns(cls, wall_ns: int) -> Time:
        """Convert ns since 1970 to a `Time`, limited to the range of int32 (1901 to 2038)."""
        sec, nanosec = divmod(wall_ns, NS_PER_S)
        return cls(max(-(2**31), min(2**31 - 1, sec)), nanosec)

    def to_ns(self) -> int:
        """Return the time in ns since 1970."""
        return self.sec * NS_PER_S + self.nanosec


class Header(Message, frozen=True):
    """Time at which the data was measured, and the frame in which it is expressed."""

    stamp: Time = Time()
    """Wall-clock time at which the data was measured."""
    frame_id: str = ""
    """Name of the frame, such as `odom` or `base_link`."""


class Vector3(Message, frozen=True):
    """A vector. The field that contains it defines the unit."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(Message, frozen=True):
    """A rotation as a unit quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Twist(Message, frozen=True):
    """Velocity: `linear` m/s, `angular` rad/s. A planar base uses only linear.x and angular.z."""

    linear: Vector3
    angular: Vector3


class TwistStamped(Message, frozen=True):
    """A velocity at the time `header.stamp`, in the frame `header.frame_id`."""

    header: Header
    twist: Twist


class Pose(Message, frozen=True):
    """A pose: `position` in m, and `orientation` as a rotation."""

    position: Vector3
    orientation: Quaternion


class PoseStamped(Message, frozen=True):
    """A pose in the frame `header.frame_id` at the time `header.stamp`."""

    header: Header
    pose: Pose


class PoseWithCovariance(Message, frozen=True):
    """A pose and its 6x6 covariance, row major.

    The axes are x, y, z in m, then roll, pitch, yaw in rad.
    """

    pose: Pose
    covariance: Covariance


class TwistWithCovariance(Message, frozen=True):
    """A twist and its 6x6 covariance, row major.

    The axes are linear x, y, z in m/s, then angular x, y, z in rad/s.
    """

    twist: Twist
    covariance: Covariance


class Odometry(Message, frozen=True):
    """Pose of the frame `child_frame_id` in the frame `header.frame_id`, and its velocity.

    The velocity (`twist`) is expressed in the frame `child_frame_id`.
    """

    header: Header
    """Sample time, and the frame of the pose."""
    child_frame_id: str
    """Frame of the robot, such as `base_link`."""
    pose: PoseWithCovariance
    """Pose in `header.frame_id`, m and rad."""
    twist: TwistWithCovariance
    """Velocity in `child_frame_id`, m/s and rad/s."""

    @property
    def yaw(self) -> float:
        """Heading of the pose, rad, left is +, computed from its quaternion."""
        turn = self.pose.pose.orientation
        return math.remainder(2.0 * math.atan2(turn.z, turn.w), math.tau)

    @property
    def time(self) -> float:
        """Time of the sample, `header.stamp`, s since 1970."""
        return self.header.stamp.to_ns() / NS_PER_S


class Transform(Message, frozen=True):
    """A transform: `translation` in m, and `rotation`."""

    translation: Vector3
    rotation: Quaternion


class TransformStamped(Message, frozen=True):
    """Pose of the frame `child_frame_id` in the frame `header.frame_id`."""

    header: Header
    """Time of the transform, and its parent frame."""
    child_frame_id: str
    """The child frame."""
    transform: Transform
    """Pose of the child frame in the parent frame."""


class TFMessage(Message, frozen=True):
    """A list of transforms."""

    transforms: list[TransformStamped]


class JointState(Message, frozen=True):
    """State of the wheel joints, or a command for the wheels.

    `position` is in rad and grows beyond 2 pi. `velocity` is in rad/s. `effort` is not used.
    """

    header: Header = Header()
    name: Annotated[list[str], MAX_64_ITEMS] = []
    """Name of each joint. `position` and `velocity` have the same order."""
    position: Annotated[list[float], MAX_64_ITEMS] = []
    """Angle of each wheel, rad. It grows beyond 2 pi."""
    velocity: Annotated[list[float], MAX_64_ITEMS] = []
    """Speed of each wheel, rad/s, forward is positive."""
    effort: Annotated[list[float], MAX_64_ITEMS] = []
    """Not used."""


class Imu(Message, frozen=True, kw_only=True):
    """An inertial measurement in the frame `header.frame_id`.

    `angular_velocity` is in rad/s and `linear_acceleration` in m/s2. Each quantity has a 3x3
    covariance, row major. A covariance that begins with -1 means that the quantity is not
    measured.
    """

    header: Header = Header()
    orientation: Quaternion = Quaternion()
    """Not used by the daemon."""
    orientation_covariance: Covariance3 = field(default_factory=UNKNOWN.copy)
    angular_velocity: Vector3
    """Turn rates, rad/s. The daemon uses z, positive to the left."""
    angular_velocity_covariance: Covariance3 = field(default_factory=UNKNOWN.copy)
    linear_acceleration: Vector3 = Vector3()
    """Acceleration, m/s2. Not used by the daemon."""
    linear_acceleration_covariance: Covariance3 = field(default_factory=UNKNOWN.copy)


class SpeedLimit(Message, frozen=True, kw_only=True):
    """A limit of the robot's speed, as in nav2_msgs/SpeedLimit.

    A `speed_limit` of 0.0 ends the limit.
    """

    header: Header = Header()
    percentage: bool = False
    """True if `speed_limit` is in % of the configured `limits.linear_speed`, false if in m/s."""
    speed_limit: float
    """Highest forward speed, m/s or %; 0.0 ends the limit."""


class Battery(Message, frozen=True):
    """The battery as the board reports it, with the fields of sensor_msgs/BatteryState.

    A value that is not measured is null, and NaN in CDR.
    """

    header: Header
    voltage: Float32 | None = None
    """Voltage, V."""
    temperature: Float32 | None = None
    """Temperature of the battery, degrees Celsius. The daemon never measures it."""
    current: Float32 | None = None
    """Current, A. It is negative while the battery discharges."""
    charge: Float32 | None = None
    """Charge, Ah. The daemon never measures it."""
    capacity: Float32 | None = None
    """Capacity, Ah. The daemon never measures it."""
    design_capacity: Float32 | None = None
    """Capacity by design, Ah. It is always null."""
    percentage: Float32 | None = None
    """State of charge, 0 to 1."""
    power_supply_status: Annotated[Byte, one_of(range(5))] = 0
    """0 unknown, 1 charging, 2 discharging, 3 not charging, 4 full.

    The daemon derives the value from the sign of `current`, so it never sends 4.
    """
    power_supply_health: Annotated[Byte, one_of(range(9))] = 0
    """Always 0, unknown."""
    power_supply_technology: Annotated[Byte, one_of(range(9))] = 0
    """Always 0, unknown."""
    present: bool = False
    """Whether the board reports a battery at present."""
    cell_voltage: Annotated[list[Float32], MAX_64_ITEMS] = []
    """Voltage of each cell, V. The list is always empty."""
    cell_temperature: Annotated[list[Float32], MAX_64_ITEMS] = []
    """Temperature of each cell, degrees Celsius. The list is always empty."""
    location: str = ""
    """Always empty."""
    serial_number: str = ""
    """Always empty."""


class BatterySummary(Message, frozen=True):
    """The main values of the battery. A value that the board does not report now is null."""

    volts: float | None
    """Voltage, V."""
    percent: float | None
    """State of charge, 0 to 100."""
    amps: float | None
    """Current, A. It is negative while the battery discharges."""
    level: Annotated[str, one_of(get_args(BatteryLevel))]
    """Level according to the thresholds in `[battery]`; `ok` if no threshold is set.

    `unknown` means that the board does not report the quantity of the thresholds (V or %), or has
    reported it only for a few seconds so far.
    """


class SourceState(Message, frozen=True):
    """A named source of commands, as the list `commands.sources` configures it."""

    name: str
    """Name of the source, the last part of the key `cmd/<source>`."""
    priority: int
    """The source with the highest number that sends drives the robot."""
    age: float | None
    """Seconds since the last accepted command of the source.

    Some events, such as the start or a `clear`, require a zero from each sender. After such an
    event, the age is null until the next command is accepted.
    """
    waits_for: str
    """Condition that must be met before the source can drive the robot, such as "a command".

    It is empty while the source drives the robot. It is a text for people; programs use `wait`.
    """
    # Only `RobotState.reason` says that zeros keep the robot at rest. No source waits for "zeros".
    wait: Annotated[str, one_of(code for code in get_args(WaitCode) if code != "zeros")]
    """Kind of the condition `waits_for`.

    - nothing: the source need not wait.
    - command: the source has sent no command within its timeout.
    - neutral: a sender of the source must send a zero first.
    - unproven, early: the clock of the sender is new or was set, and its delays are not proved yet.
    - stale, set_back, stamps: the stamps show late commands, for long, or are no times.
    - too_old, round_trip: the echoes show late commands, or such a round trip for long.
    - no_echo, other_run, from_future: the command has no echo of a beat of this daemon.
    - not_newer: the command is not newer than the last accepted one of its sender.
    - copied: two programs send with one sender id.
    - stalled: the daemon stalled, and waits for the next command.
    - higher, equal: a source of higher or of the same priority controls the robot.
    - senders: other senders of this source wait until the sender that drives falls silent.
    """
    linear: float | None = None
    """Forward speed in the last accepted command, m/s; null like `age`."""
    angular: float | None = None
    """Turn rate in the last accepted command, rad/s; null like `age`."""
    longest_gap: float = 0.0
    """Longest time from a speed to its sender's next accepted command in the last 30 to 60 s, s.

    In a gap above the timeout of the source the robot has braked. A gap above 5 s is the end of a
    drive, and does not count.
    """


class Spread(Message, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, us."""

    count: int
    """Number of measurements."""
    p50: float
    """Median, us."""
    p99: float
    """99th percentile, us."""
    max: float
    """Largest measurement, us."""


class Latency(Message, frozen=True):
    """Statistics of one latency of the daemon, such as the time from a command to its line."""

    since_start: Spread
    last_minute: Spread


class Cause(Message, frozen=True):
    """Why the robot is stopped, in fault or switched off, until a call releases it."""

    number: CauseNumber
    """Number that `clear` or `activate` names. No other cause of this robot ever has it."""
    kind: Annotated[str, one_of(get_args(CauseKind))]
    """`clear` releases a fault and a stop, and `activate` releases `inactive`."""
    code: Annotated[str, one_of(get_args(StateCode))]
    """Code of `text`."""
    text: str
    """The cause in words."""
    by: str
    """Name of the client that stopped the robot or switched it off; empty if none did."""
    stamp: Time
    """Wall-clock time of the cause."""
    kept: bool
    """True for a cause from before the last start of the daemon."""
    age: float | None
    """Seconds since this daemon first published the cause; null before the next control period."""


class RobotState(Message, frozen=True):
    """Summary of the robot: mode and reason, pose (m, rad), twist (m/s, rad/s), wheels (rad/s).

    Without feedback the speeds are unknown: `linear` and `angular` are null, and `wheels` is empty.
    """

    stamp: Time
    """Wall-clock time of this message."""
    mode: Annotated[str, one_of(mode.value for mode in Mode)]
    """What the robot does now."""
    reason: str
    """Why the robot moves or does not move. It is a text for people; programs use `code`."""
    x: float
    """Position in the frame odom, m."""
    y: float
    """Position in the frame odom, m."""
    yaw: float
    """Heading in the frame odom, rad, left is positive, from -pi to pi."""
    linear: float | None
    """Measured forward speed, m/s; null without feedback."""
    angular: float | None
    """Measured turn rate, rad/s, left is positive; null without feedback."""
    wheels: list[float]
    """Measured speeds, rad/s, in the order front right, front left, rear left, rear right; if two
    wheels are driven: right, left."""
    link: Annotated[str, one_of(get_args(LinkState))]
    """State of the serial link to the board."""
    source: str
    """Name of the selected source; empty if none is selected."""
    sources: list[SourceState]
    """All configured sources, in the order of their priority."""
    refused: str
    """The last command that was refused, and the reason; empty if no command was refused."""
    counters: dict[str, int]
    """Counters since the start of the daemon, by name."""
    certificate_expiry: str = ""
    """Remaining validity of the TLS certificates of the bus, in words; empty without TLS."""
    latencies: dict[str, Latency] = {}
    """Latencies of the daemon by name (`daemon/latencies.py`). They are up to one second old."""
    gyro: Annotated[str, one_of(get_args(GyroDoes))] = "off"
    """State of the gyro. The heading comes from the gyro in the states `used` and `disagrees`.

    In the state `waiting for turn`, the gyro has not agreed with the wheels in a turn yet.
    """
    encoder_counts: list[int] = []
    """Configured encoder counts per wheel turn, in the order of `wheels`.

    All values are 0 if no counts are configured. They are also 0 if the reported speeds do not
    match the configured counts: each speed should be an integer number of counts divided by a
    time.
    """
    wheel_fault: str = ""
    """Description of a wheel that does not obey its command or that the odometry ignores, or of a
    side whose wheels slip.

    It is empty if there is no such wheel or side.
    """
    pose_doubt: Annotated[str, one_of(["", *get_args(PoseCode)])] = ""
    """Code of why the pose may be far off although the link is up; empty if nothing shows that.

    `encoder_counts_missing` advises `mcu.encoder_counts`, `coarse_encoder` `mcu.link_check = "on"`,
    and `not_calibrated` `acsard calibrate`.
    """
    sender: str = ""
    """Public name of the selected sender of `source`; empty while no sender is selected.

    A selected sender does not always drive. It may still have to send a zero first, or a latch may
    keep the robot from driving.
    """
    recording_error: str = ""
    """Why recording fails at present, in words; empty if recording works or is switched off."""
    causes: list[Cause] = []
    """Everything that holds the robot until it is released, the newest last."""
    latch_file_error: str = ""
    """Why a latched stop would be lost if the daemon restarted now, in words.

    It is empty if the stop would stay latched. It is also empty if the daemon keeps no latch file,
    as with the built-in simulator.
    """
    feedback_age: float | None = None
    """Seconds since the last valid feedback line of the board; null before the first feedback
    line."""
    emergency_stop: Annotated[str, one_of(get_args(EstopState))] = ""
    """State of the emergency-stop input; empty if the board has never reported this input.

    `silent` means that the board has stopped reporting the input, which counts as pressed.
    """
    bumpers: list[bool] | None = None
    """Whether each of the 1 to 4 bumpers counts as pressed, in the order of the board's reports.

    Null if the board has never reported its bumpers. If the board has stopped reporting them, all
    bumpers count as pressed, so all values are true.
    """
    battery: BatterySummary | None = None
    """The battery; null if the board has never reported its voltage or its charge."""
    settings_differ: str = ""
    """Settings that `set` changed since the daemon's start, in words; else empty."""
    speed_limit: str = ""
    """The speed limit in force below `limits.linear_speed`, with its sender, in words.

    It is empty if there is none.
    """
    certificate_days: float | None = None
    """Number of days until the first of the certificates that TLS needs expires.

    It is negative after this time. It is null without TLS, or while the time is unknown.
    """
    certificate: Annotated[str, one_of(("", *get_args(Expiry)))] = ""
    """Whether the TLS certificates of the bus are valid; empty without TLS.

    - valid: at least 30 days remain.
    - expires: fewer than 30 days remain.
    - expired: a certificate has expired.
    - unknown: the time at which they expire is unknown.
    """
    code: Annotated[str, one_of(get_args(StateCode))] = ""
    """Code of `reason`. With several `causes`, it is the code of the newest fault, else of the
    newest stop."""
    version: str = ""
    """Version of the daemon, such as `0.2.0`, or `0.2.0.dev0+g1a2b3c4d5` if it is not a release."""

    @property
    def why(self) -> str:
        """The reason, with its code if this version does not know it."""
        return received_text(self.code, self.reason)


class GatewayState(Message, frozen=True):
    """Status that the TLS gateway (`acsard gateway`) reports to the daemon."""

    opened: Annotated[int, Meta(ge=0, lt=1 << 62)]
    """Start time of the gateway by the machine's monotonic clock, ns.

    If the value changes, the gateway has restarted.
    """
    connections: Annotated[int, Meta(ge=0, lt=1 << 16)]
    """Number of connections from the network at present."""
    full: Annotated[int, Meta(ge=0, lt=1 << 31)]
    """Number of checks since the start of the gateway in which all its connections were in use.

    The gateway makes four checks per second.
    """
    certificate_ends: Annotated[int, Meta(ge=0, lt=1 << 62)] = 0
    """Earliest time at which one of the TLS certificates expires, wall-clock ns since 1970. It is 0
    if the Python library that reads certificates is missing."""


class KeyValue(Message, frozen=True):
    """A diagnostic value as text."""

    key: str
    value: str


class DiagnosticStatus(Message, frozen=True):
    """A diagnostic status; `level` is 0 ok, 1 warning, 2 error, 3 stale."""

    level: Annotated[Byte, one_of(range(4))]
    """0 ok, 1 warning, 2 error, 3 stale."""
    name: str
    """Part of the robot, such as `acsard: board`."""
    message: str
    """State of the part, in words."""
    hardware_id: str
    """Id of the robot."""
    values: list[KeyValue]
    """Figures, and `advice` for a part that is not ok."""


class DiagnosticArray(Message, frozen=True):
    """The diagnostic status of each part of the robot."""

    header: Header
    status: list[DiagnosticStatus]


class LogEvent(Message, frozen=True):
    """An event that the daemon has logged."""

    stamp: Time
    """Wall-clock time of the last occurrence."""
    name: Annotated[str, one_of(get_args(EventName))]
    """Name of the event."""
    level: Annotated[str, one_of(get_args(Level))]
    """Level in the log."""
    text: str
    """The event in words."""
    by: str
    """Name of the client that caused the event; empty if no client caused it."""
    count: int
    """How often the event has occurred.

    If an event only repeats an earlier event of the last minute, both share one row, and this
    number grows.
    """
    code: Annotated[str, one_of(("", *get_args(Code)))] = ""
    """Code of the cause; empty if `name` says everything.

    If the event stands for several events, it is the code of the last one.
    """


class Events(Message, frozen=True):
    """The last events, oldest first.

    An event and its repetitions share one row, which has the time of the last repetition. Each
    repetition moves the row to the end of the list.
    """

    stamp: Time
    """Time of the last event."""
    total: int
    """Number of events that the daemon has logged since its start.

    Events that share one line of the log count once. If `total` is larger by N than in the
    previous message, all new events are in the last N rows.
    """
    events: list[LogEvent]


class Change(Message, frozen=True):
    """The old and the new value of a setting."""

    old: Plain
    new: Plain


class ReplyData(Message, frozen=True):
    """What a service call has changed, for programs."""

    numbers: list[CauseNumber] = []
    """Numbers of the causes that the call has latched or released, as in `RobotState.causes`."""
    changes: dict[str, Change] = {}
    """The settings that the call has changed, by dotted key."""
    loan: CauseNumber | None = None
    """Number of the loan of the serial port by `deactivate` with `release_port`."""


class ServiceReply(Message, frozen=True):
    """Result of a service call. `message` gives the outcome, or the mistake and its fix."""

    success: bool
    """Whether the call had its effect."""
    message: str
    """A text for people; programs use `data`."""
    data: ReplyData = ReplyData()
    """The changes that the call made."""


class SetPose(Message, frozen=True):
    """Pose of base_link in the frame odom to be set: `x` and `y` in m, `yaw` in rad."""

    x: float
    y: float
    yaw: float


class Release(Message, frozen=True):
    """Payload of the services `clear` and `activate`, with the causes that they release."""

    numbers: Annotated[list[CauseNumber], MAX_64_ITEMS] | None = None
    """Numbers of the causes to release, as in `RobotState.causes`; others stay.

    If it is null, the client may not know a cause yet. Such a `clear` releases the faults if there
    are any, else the stops. It is refused while one of them has been published for less than 2 s.
    The same holds for an `activate`.
    """


class SwitchOff(Message, frozen=True):
    """Payload of the service `deactivate`."""

    release_port: bool = False
    """Also lend the serial port to another program, if the robot rests. A robot that is stopped or
    in fault stays so, and only the port is closed. It opens again at the next `activate` that names
    the number of this loan (`ReplyData.loan`), or that is not refused; until then, a second program
    is refused. The borrower may move the robot, so the pose is less certain after it, by up to 10 m
    and 3.2 rad, until `reset_odometry` or `set_pose`."""


class Settings(Message, frozen=True):
    """New values for settings, by the dotted keys of the settings in `acsard.toml`."""

    settings: Annotated[dict[str, Plain], MAX_64_ITEMS]
    """New values by key, such as `{"limits.linear_speed": 0.8}`."""


class Info(Message, frozen=True):
    """Identity, version and connections of the daemon."""

    id: str
    """Id of the robot, `robot.id`."""
    version: str
    """Version of the daemon."""
    pid: int
    """Process id of the daemon."""
    port: str
    """Path of the serial port of the board."""
    simulated: bool
    """Whether the built-in simulator replaces the board."""
    rate: float
    """Control rate, Hz."""
    listen: list[str]
    """Endpoints at which the daemon listens."""
    connect: list[str]
    """Endpoints of routers to which the daemon connects."""
    services: dict[str, list[str]] = {}
    """The services of the robot, each with the fields that its payload may have."""


class HardwareInterface(Message, frozen=True):
    """An interface of a joint, as in a line of `ros2 control list_hardware_interfaces`."""

    name: str
    """Joint and quantity: `<joint>/velocity` or `<joint>/position`."""
    kind: Annotated[str, one_of(("command", "state"))]
    """`command`: sources write it. `state`: the daemon writes it."""
    unit: Annotated[str, one_of(("rad", "rad/s"))]
    available: bool
    """Whether the link to the board is up."""
    claimed: bool
    """True for a command interface while a source drives."""


class Interfaces(Message, frozen=True):
    """The command and state interfaces of the base."""

    interfaces: list[HardwareInterface]


class TopicInfo(Message, frozen=True):
    """One row of the table of keys that `acsard topics` shows."""

    key: str
    """The whole key, such as `acsard/acsar/odom`."""
    direction: Annotated[str, one_of(get_args(Direction))]
    """`out` from the daemon, `in` to it; the daemon answers `query` and `service`."""
    type: str
    """Name of the message type."""
    rate: str
    """How often it is sent, in words."""
    note: str
    """Contents, in words."""


class Topics(Message, frozen=True):
    """The table of all keys of this daemon."""

    topics: list[TopicInfo]


class Beat(Message, frozen=True):
    """The time of the daemon, which a program copies into its commands as their `echo`.

    The numbers are below 2^53, so JavaScript represents them exactly.
    """

    run: Annotated[int, Meta(ge=0, lt=1 << 48)]
    """A random number, which is new at each start of the daemon."""
    boot_us: Annotated[int, Meta(ge=0, lt=1 << 53)]
    """The time since the start of the daemon's computer (CLOCK_BOOTTIME), in us."""


class WhoAmI(Message, frozen=True):
    """The role and the name of the client that sent the query."""

    role: Annotated[str, one_of(ROLES)]
    """The role in the queried key. The client has at least this role, because otherwise the access
    rules would have blocked the query."""
    sender: str
    """The client's public name and its transport, as in the log."""


MESSAGES: dict[str, type[Message]] = {
    cls.__name__: cls
    for cls in (
        Odometry,
        TFMessage,
        JointState,
        PoseStamped,
        Imu,
        Battery,
        SpeedLimit,
        Twist,
        TwistStamped,
        RobotState,
        GatewayState,
        DiagnosticArray,
        Events,
        ServiceReply,
        SetPose,
        Release,
        SwitchOff,
        Settings,
        Info,
        Interfaces,
        Topics,
        WhoAmI,
        Beat,
    )
}
"""Maps the name of each complete message type to the type. Types that are only parts of messages
are not included. A query of the key `schema/<Type>` returns the JSON Schema of a type."""

BOTH_WAYS: dict[str, type[Message]] = {
    f"{cls.__name__}In": cls for cls in (TwistStamped, JointState, Imu)
}
"""Types that the daemon both publishes and receives, by the name of the schema of the received."""

SCHEMA_NAMES = (*MESSAGES, *BOTH_WAYS, "Config")
"""The `<Type>` of each key `schema/<Type>`. The schemas are in `json_schema.py`, which takes 17 ms
to make them."""
