"""The value types that all modules share, in SI units and with the wheel order `WHEELS`.

This module reads no clock, does no I/O and decides nothing. Types with `gc=False`, which saves
time, are never part of a reference cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from msgspec import Meta, Struct

from acsard.core.codes import Code, RefusalCode
from acsard.core.tables.message_codes import ObjectionCode
from acsard.core.tables.motor_codes import GuardCode
from acsard.core.tables.sender_codes import WaitCode

# The order of every value with one item per wheel. If only two wheels are driven, their values are
# the first two, and those of the rear wheels are equal to them.
WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
TWO_WHEELS = ("right", "left")  # names of two driven wheels

# Types that name the unit and the clock of a value, so that no sentence has to.
Ns = int  # monotonic time, or a duration, ns
WallNs = int  # time since 1970 by a wall clock, ns
Seconds = float
Rad = float
RadPerS = float
Metres = float

Wheels4 = tuple[float, float, float, float]  # a value of each wheel, in `WHEELS` order


def wheel_names(count: int) -> tuple[str, ...]:
    """Return the names of four wheels or two, in the order of their values."""
    return WHEELS if count == len(WHEELS) else TWO_WHEELS


def wheels4(values: Sequence[float]) -> Wheels4:
    """Return the values of four wheels, in `WHEELS` order, from those of all wheels or of two."""
    right, left, rear_left, rear_right = values if len(values) == 4 else (*values, *values[::-1])
    return right, left, rear_left, rear_right


NS_PER_S = 1_000_000_000
NS_PER_US = 1000

ROOT_KEY = "acsard"  # of every native (non-ROS) key: `acsard/<robot.id>/...`

# Each role has the permissions of those before it.
Role = Literal["viewer", "operator", "maintainer"]

ROLES: tuple[Role, ...] = get_args(Role)

Trip = GuardCode | Literal[""]  # why the guard replaced a line


class AcsardError(Exception):
    """Base of the errors that acsard raises on purpose. Any other exception is a bug."""


class Instant(Struct, frozen=True, gc=False):
    """One moment by two clocks: ages and periods are of `mono_ns`, stamps are `wall_ns`."""

    mono_ns: Ns
    wall_ns: WallNs


class Twist(Struct, frozen=True, gc=False):
    """Velocity of base_link along x, m/s, and about z, rad/s, positive to the left."""

    linear: float = 0.0
    angular: float = 0.0


class Motion(Struct, frozen=True):
    """An allowed twist, and the acceleration of each axis that led to it."""

    twist: Twist = Twist()
    linear_slope: float = 0.0
    angular_slope: float = 0.0


class Pose(Struct, frozen=True, gc=False):
    """Planar pose of base_link in the frame odom, m and rad, with the yaw from -pi to pi."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0


class WheelSpeeds(Struct, frozen=True, gc=False):
    """Angular velocity of each wheel in rad/s, positive when it drives the robot forward."""

    front_right: float = 0.0
    front_left: float = 0.0
    rear_left: float = 0.0
    rear_right: float = 0.0

    def as_tuple(self) -> Wheels4:
        return self.front_right, self.front_left, self.rear_left, self.rear_right


REST = Twist()
STILL = WheelSpeeds()
AT_REST = Motion()  # without a ramp, if it replaces another motion


class PoseCovariance(Struct, frozen=True, gc=False):
    """Upper triangle of the covariance of (x, y, yaw) in the frame odom, m2, m rad and rad2."""

    xx: float
    xy: float
    xyaw: float
    yy: float
    yyaw: float
    yawyaw: float


class TwistVariances(Struct, frozen=True, gc=False):
    """Variances of a twist of the odometry, m2/s2 and rad2/s2."""

    linear: float
    lateral: float
    angular: float


class Received(Struct, frozen=True):
    """The bytes of one read of the serial port."""

    at: Instant
    data: bytes


class Echo(Struct, frozen=True, gc=False):
    """The beat that a sender received last: the run of a daemon, and its CLOCK_BOOTTIME."""

    run: int
    beat_ns: Ns


class Command(Struct, frozen=True, omit_defaults=True):
    """A velocity that a sender requests.

    - source: command source, such as `app` for the key `cmd/app`.
    - sender: public name of the program, or of what is known (see `shared`).
    - arrived_ns: arrival, by which the command's age is computed.
    - stamp_ns: time of sending by the clock `clock`, which is not synchronized with the daemon's.
    """

    source: str
    twist: Twist
    arrived_ns: Ns
    stamp_ns: Ns | None = None
    clock: str = ""
    sender: str = ""
    # `twist` is zero because the robot cannot make the motion, such as one along y: it does not
    # arm.
    cancelled: bool = False
    # Number by the sender, if it numbers its commands; a gap is a lost command.
    sequence: int | None = None
    # Without a sender id and a GID, several programs may have the same `sender`: only the Zenoh
    # session, maybe of a router or a bridge, or only the key.
    shared: bool = False
    ros: bool = False  # some ROS tools never send a zero, which a text about one mentions
    bridged: bool = False  # by a bridge of ROS, which numbers no commands
    stamp_replaced: bool = False  # by Zenoh, because the sender's clock is ahead of the daemon's
    echo: Echo | None = None
    # At `arrived_ns`, the time since the echoed beat; below 0 for a beat from the future. None
    # without an echo, and for one of another run.
    age_ns: Ns | None = None


class Announcement(Struct, frozen=True):
    """A liveliness token of a ROS publisher on the topic of a source has appeared or disappeared.

    `sender` is the public name of its commands. For `BRIDGES`, a bridge with such a publisher came
    or went, and `present` says whether there is still one.
    """

    source: str
    sender: str
    present: bool
    at_ns: Ns


BRIDGES = "bridge"

Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

# Value of a setting in a request; 64 bits as in a recording.
Plain = (
    bool | Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)] | float | str | list[float | str]
)


class Request(Struct, frozen=True, omit_defaults=True):
    """A call of a service, or a stop that was published on the bus, with `id` 0 and no reply."""

    if TYPE_CHECKING:
        verb: Verb
    else:
        verb: str  # in a recording of a later version
    id: int = 0
    pose: Pose | None = None
    asked_ns: Ns | None = None  # arrival (None: this step); `clear` does not release a later stop
    by: str = ""  # client, as `core/incoming/commands.py` names it
    settings: dict[str, Plain] = {}  # of the verb `set`, by dotted key
    # Of the causes that `clear` or `activate` releases, if the client names them.
    numbers: tuple[int, ...] | None = None
    release_port: bool = False  # of `deactivate`


class Answer(Struct, frozen=True):
    id: int
    success: bool
    message: str
    numbers: tuple[int, ...] = ()  # of the causes that were latched or released
    changes: dict[str, tuple[Plain, Plain]] = {}  # old and new value by dotted key
    loan: int | None = None  # number of the loan of the serial port that began


class Refusal(Struct, frozen=True, omit_defaults=True):
    """A message from a client that the daemon refused.

    The robot counts it in `command_<reason>`, or in `commands_of_new_senders` if it is `unproven`.
    """

    reason: RefusalCode
    text: str
    source: str = ""
    sender: str = ""
    arrived_ns: Ns = 0  # 0: unknown


# Events in the log; `deploy/manual/pages/reference/events.md` explains each.
EventName = Literal[
    "started", "ended", "signal", "configuration", "real_time", "connecting",
    "port_open", "port_waiting", "port_lost",
    "link_down", "link_booting", "link_up", "link_stale", "link_check", "mcu_restarted",
    "lines_rejected", "lines_implausible", "lines_lost", "pose_doubtful", "uncommanded_motion",
    "wheel_fault",
    "emergency_stop", "emergency_stop_released", "bumper_pressed", "bumper_released",
    "battery", "battery_stop",
    "gyro", "imu_refused",
    "bus_stuck", "router_missing", "router_found", "not_a_router", "certificate",
    "missed_periods", "recording", "latch_file",
    "gateway_open", "gateway_full", "gateway_stuck", "gateway_lost_daemon", "gateway_ended",
    "page_ended", "page_refused",
    "router_open",
    Verb,
    "speed_limit",
    "mode", "commander", "commands_without_effect", "new_sender", "command_refused", "fault",
]  # fmt: skip

Level = Literal["debug", "info", "warning", "error"]


class Event(Struct, frozen=True, omit_defaults=True):
    """An event for the log. `event_throttle.py` joins frequent ones."""

    # A recording of a later version may have names and codes that this one does not know, so its
    # decoder accepts any text.
    if TYPE_CHECKING:
        name: EventName
    else:
        name: str
    text: str
    level: Level = "info"
    by: str = ""  # client that caused it
    kind: str = ""  # finer than `name`, such as the reason of a refusal; a joined line counts each
    count: int = 1  # occurrences
    news: bool = True  # False: only repeats an earlier event, so its line may be delayed
    # Code of the cause, of the last of several events; "" if `name` says everything.
    if TYPE_CHECKING:
        code: Code | Literal[""] = ""
    else:
        code: str = ""


class Estimate(Struct, frozen=True, gc=False):
    """The estimate of the odometry by one feedback line, valid at the time `at`."""

    at: Instant
    pose: Pose
    twist: Twist
    covariance: PoseCovariance
    twist_variances: TwistVariances
    positions: Wheels4  # rad since the daemon started, beyond a full turn
    speeds: WheelSpeeds
    asked_ns: Ns | None = None  # when the line was written that this one answers, if known
    heard_ns: Ns = 0  # the complete line was received


class Wait(Struct, frozen=True):
    """The condition that must be met before a command source drives the robot.

    The code `what` says what `source` means, and `seconds`:

    - nothing, command: it need not wait; it must send a command.
    - neutral: the source must send a zero and, if its sender's identity may be shared, then no
      speed for `seconds`.
    - an `AgeCode`: the last command of the source was refused; `seconds` and `kept` are figures.
    - zeros: the source controls the robot, but sends only zeros.
    - higher, equal: the source controls the robot with a higher or an equal priority.
    - senders: some senders of the same source must wait.
    """

    what: WaitCode | ObjectionCode
    source: str = ""
    seconds: float = 0.0
    senders: int = 0  # that wait while another one of the same source drives
    lasts: bool = False  # for neutral: for a while it has sent speeds without a zero
    # Source, or "another sender of NAME", whose speeds have no effect against zeros of `source`.
    # Of an `AgeCode`: a figure in words.
    kept: str = ""
    ros: bool = False  # the sender that must send a zero uses ROS
    shared: bool = False  # several programs may share its identity
    pause: bool = False  # silence for `seconds` arms it too


class SourceStatus(Struct, frozen=True):
    """The state of a command source.

    `age_s` is the time since its last accepted command, s, and None after an event that requires a
    zero. `twist` is that of this command.
    """

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait
    twist: Twist | None = None
    longest_gap_s: Seconds = 0.0  # from a speed to the next accepted command, in the last minute


class WheelsStatus(Struct, frozen=True):
    """The verdicts on the wheels that are no reason to stop."""

    text: str = ""
    excluded: tuple[str, ...] = ()  # wheels that the odometry ignores
    slipping: tuple[str, ...] = ()  # sides, `left` or `right`, within half a second


class RoutersStatus(Struct, frozen=True):
    """The endpoints in `bus.connect`, with and without a connection."""

    connected: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()  # connected peers, which forward nothing


class GyroSample(Struct, frozen=True, omit_defaults=True):
    """A turn rate about z of base_link by a gyro, rad/s, positive to the left.

    `variance` is in rad2/s2, 0 if unknown. `anew` is True for the first sample of another gyro.
    """

    at_ns: Ns  # arrival
    stamp_ns: Ns | None  # measurement, by the sender's clock
    rate: float
    variance: float = 0.0
    anew: bool = False


# The heading is the gyro's in `used` and `disagrees` (gyro and wheels turn differently); otherwise
# the wheels'.
GyroDoes = Literal[
    "off", "waiting for rest", "waiting for turn", "used", "silent", "hangs", "disagrees",
    "reversed", "in degrees", "dead", "not believed",
]  # fmt: skip


class GyroStatus(Struct, frozen=True):
    """The state of the gyro."""

    does: GyroDoes = "off"
    bias: float | None = None  # at rest, rad/s; None while unknown


# `silent`: no longer reported, which counts as pressed.
EstopState = Literal["", "released", "pressed", "silent"]


# Level by the thresholds in `[battery]`; unknown: not reported, or for only a few seconds so far.
BatteryLevel = Literal["ok", "warning", "stop", "unknown"]


class BatteryStatus(Struct, frozen=True, gc=False):
    """The battery as the board reports it; None for what it does not report now."""

    level: BatteryLevel
    reported_ns: Ns | None = None  # last report
    volts: float | None = None
    percent: float | None = None  # 0 to 100
    amps: float | None = None  # negative while the battery discharges
    mean: float | None = None  # V or % over about 10 s, compared with the thresholds


# `clear` releases faults and stops, and `activate` releases `inactive`.
CauseKind = Literal["fault", "stop", "inactive"]


class Cause(Struct, frozen=True):
    """Why the robot is stopped, in fault or switched off, until a person releases it."""

    number: int  # never used twice for a robot; below 2^53, so JavaScript represents it exactly
    kind: CauseKind
    code: Code
    text: str  # in words
    part: str = ""  # of the robot, such as a wheel, unless the code says it
    by: str = ""  # client, if one asked for it
    at_ns: WallNs = 0
    kept: bool = False  # from before this run of the daemon


class Latches(Struct, frozen=True):
    """The causes in force, the newest last; `core/motion/latches.py` adds and releases them.

    The daemon stores them in a file, so that they last even if it is killed.
    """

    causes: tuple[Cause, ...] = ()
    last: int = 0  # the number of the newest cause that there ever was

    def of(self, *kinds: CauseKind) -> tuple[Cause, ...]:
        """Return the causes of these kinds, the newest first."""
        return tuple([cause for cause in reversed(self.causes) if cause.kind in kinds])


class SpeedCap(Struct, frozen=True):
    """A speed limit from the key `speed_limit`, beside `limits.linear_speed`."""

    speed: float | None  # m/s; None lifts the limit
    by: str = ""  # sender, for the log


class Heard(Struct, frozen=True, omit_defaults=True):
    """What arrived since the last wake-up of the control loop.

    - opened: openings of the serial port; a new one is a new session with the board.
    """

    port_open: bool
    opened: int = 0
    port_trouble: str = ""  # why the port is closed
    received: tuple[Received, ...] = ()
    commands: tuple[Command, ...] = ()
    refusals: tuple[Refusal, ...] = ()  # messages that did not become a `Command`
    requests: tuple[Request, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    speed_cap: SpeedCap | None = None  # the newest one
    events: tuple[Event, ...] = ()  # of other parts, to be logged with the robot's
    missed: int = 0  # control periods without a wake-up
    shutting_down: bool = False  # ramp to zero, and stay there
    announced: tuple[Announcement, ...] = ()

    @property
    def asks_nothing(self) -> bool:
        """Whether there are at most bytes, gyro samples and events."""
        return not (
            self.commands
            or self.announced
            or self.refusals
            or self.requests
            or self.speed_cap is not None
            or self.shutting_down
        )


class Status(Struct, frozen=True):
    mode: str
    code: Code  # why the robot moves or does not move
    reason: str  # in words
    link: str
    # Selected by the arbiter, which does not always drive: it may need a zero, or a latch holds.
    source: str = ""
    battery: BatteryLevel | Literal[""] = ""  # "" if the board does not report it
    numbers: tuple[int, ...] = ()  # of the causes in force: with a new one, `state` is due at once


class News(Struct, frozen=True):
    """What the robot makes of what it heard.

    - urgent: the board should get a new line at once, for another speed or mode, or because an
      input was pressed.
    - status_changed: there is another `Robot.status`.
    """

    estimates: tuple[Estimate, ...] = ()
    answers: tuple[Answer, ...] = ()
    events: tuple[Event, ...] = ()
    urgent: bool = False
    status_changed: bool = False


class Recording(Struct, frozen=True):
    """The state of the recorder."""

    where: str = ""  # directory, or "" if recording is off
    trouble: str = ""  # why recording fails at present
    missing: int = 0  # steps
