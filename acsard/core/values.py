"""The value types of acsard, in SI units, that every other module uses.

This module holds frozen values without behaviour beyond simple arithmetic on themselves. It reads
no clock, does no I/O and decides nothing. Types with `gc=False` are never part of a reference
cycle. Wheel order is `WHEELS` everywhere.
"""

from __future__ import annotations

from typing import Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
"""The order of every four-wheel value, index 0 to 3."""

NS_PER_S = 1_000_000_000

ROOT = "acsard"
"""The first part of every key of the native tree: `acsard/<robot.id>/...`."""

Role = Literal["viewer", "operator", "maintainer"]
"""Permission of a client on the bus. Each role includes those before it."""

ROLES: tuple[Role, ...] = get_args(Role)


class AcsardError(Exception):
    """Base of the errors that acsard raises on purpose. Any other exception is a bug."""


class Instant(Struct, frozen=True, gc=False):
    """One reading of both clocks. Ages and periods use `mono_ns`, published stamps `wall_ns`."""

    mono_ns: int
    wall_ns: int


class Twist(Struct, frozen=True, gc=False):
    """Velocity of base_link in base_link: `linear` m/s along x, `angular` rad/s, left is +."""

    linear: float = 0.0
    angular: float = 0.0


class Pose(Struct, frozen=True, gc=False):
    """Planar pose of base_link in odom: `x`, `y` in m, `yaw` in rad within [-pi, pi]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0


class WheelSpeeds(Struct, frozen=True, gc=False):
    """Angular velocity of each wheel in rad/s, positive when it drives the robot forward."""

    front_right: float = 0.0
    front_left: float = 0.0
    rear_left: float = 0.0
    rear_right: float = 0.0

    def as_tuple(self) -> tuple[float, float, float, float]:
        """Return the four speeds in `WHEELS` order."""
        return self.front_right, self.front_left, self.rear_left, self.rear_right


REST = Twist()
STILL = WheelSpeeds()


class PoseCovariance(Struct, frozen=True, gc=False):
    """Upper triangle of the covariance of (x, y, yaw) in odom: m2, m rad and rad2."""

    xx: float
    xy: float
    xyaw: float
    yy: float
    yyaw: float
    yawyaw: float


class TwistVariances(Struct, frozen=True, gc=False):
    """Variances of one report in base_link: along x and y in m2/s2, of the turn rate in rad2/s2."""

    linear: float
    lateral: float
    angular: float


class Received(Struct, frozen=True):
    """The bytes of one read of the serial port, and its time."""

    at: Instant
    data: bytes


class Command(Struct, frozen=True):
    """A velocity that one commander wishes. Three attributes identify its origin:

    - source: the name under which it commands, one of `commands.sources`: the `app` of `cmd/app`.
    - sender: its public name, as far as the envelope tells. Two programs on one source are two
      senders.
    - clock: the origin of the stamp: the sender's own attachment, Zenoh on its behalf, or a
      message's header.

    `arrived_ns` is the monotonic time of arrival and alone decides the age. `stamp_ns` is the time
    of sending by `clock`, which is not synchronized with ours.
    """

    source: str
    twist: Twist
    arrived_ns: int
    stamp_ns: int | None = None
    clock: str = ""
    sender: str = ""
    cancelled: bool = False
    """Whether the requested speeds cancel out to zero, so that the stick is not released."""
    sequence: int | None = None
    """Its number among the commands of its sender. A gap in the numbers means lost commands."""
    shared: bool = False
    """Whether several programs may look like this sender: it used a bridge, or has only its key."""
    ros: bool = False
    """Whether it came from ROS, whose tools send no zero by themselves."""
    stamp_replaced: bool = False
    """Whether Zenoh replaced its timestamp because the sender's clock is ahead of ours."""
    steady: bool = False
    """Whether the sender declares that nobody adjusts the clock of its stamp."""


Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

Plain = bool | int | float | str | list[float | str]
"""The value of a setting, as a client writes it."""


class Request(Struct, frozen=True):
    """A service call or a stop; `id` identifies the caller, 0 if nobody waits for an answer."""

    verb: Verb
    id: int = 0
    pose: Pose | None = None
    asked_ns: int | None = None
    """Monotonic time of its arrival. A clear must not undo a stop that came after it."""
    by: str = ""
    """Name of the client, as in `core/incoming/commands.py`."""
    settings: dict[str, Plain] = {}
    """The settings that `set` changes, by key as in `core/config/live.py`."""
    latch: int | None = None
    """Number of the latch that `clear` or `activate` releases; None if the client names none."""


class Answer(Struct, frozen=True):
    """The result of the `Request` with the same `id`."""

    id: int
    success: bool
    message: str


class Refusal(Struct, frozen=True):
    """A command that does not count: `reason` names its counter, and `text` is for people."""

    reason: str
    text: str
    source: str = ""
    sender: str = ""
    arrived_ns: int = 0
    """Monotonic time of its arrival. Unknown values are 0 here, and "" in `source` and `sender`."""


EventName = Literal[
    "started", "ended", "signal", "configuration", "real_time", "connecting",
    "port_open", "port_waiting", "port_lost",
    "link_down", "link_booting", "link_up", "link_stale", "link_check", "mcu_restarted",
    "lines_rejected", "lines_implausible", "lines_lost", "uncommanded_motion", "wheel_fault",
    "emergency_stop", "emergency_stop_released", "bumper_pressed", "bumper_released",
    "battery", "battery_stop",
    "gyro", "learned_track", "imu_refused",
    "bus_stuck", "router_missing", "router_found", "not_a_router",
    "missed_periods", "recording", "latch_file",
    "gateway_open", "gateway_full", "gateway_stuck", "gateway_lost_daemon", "gateway_ended",
    "page_ended", "page_refused",
    "router_open", "router_full", "router_stuck", "router_ended",
    Verb,
    "mode", "commander", "commands_without_effect", "new_sender", "command_refused", "fault",
]  # fmt: skip
"""All names of log events. `deploy/systemd/README.md` explains each of them."""

Level = Literal["info", "warning", "error"]


class Event(Struct, frozen=True):
    """An event for the log.

    `text` is for people. `event_throttle.py` writes at most a line per name and second.
    """

    name: EventName
    text: str
    level: Level = "info"
    by: str = ""
    """Name of the client that asked, sent or commands, "" without one."""
    kind: str = ""
    """A detail by which repeated events are counted separately: a reason, a change."""
    count: int = 1
    """Number of occurrences since the last line of this name."""
    news: bool = True
    """False for a repetition, which may wait for the next line."""


class Estimate(Struct, frozen=True, gc=False):
    """The result of one feedback line in the odometry. All its parts share the stamp `at`."""

    at: Instant
    pose: Pose
    twist: Twist
    covariance: PoseCovariance
    twist_variances: TwistVariances
    positions: tuple[float, float, float, float]
    """Wheel angles since the start, rad, continuous, in `WHEELS` order."""
    speeds: WheelSpeeds
    asked_ns: int | None = None
    """Monotonic time at which the answered line left, None if that line is unknown."""
    heard_ns: int = 0
    """Monotonic time at which the line was complete here."""


class Wait(Struct, frozen=True):
    """The thing that a source waits for, with the details for `core/motion/arbiter_text.py`."""

    what: Literal[
        "nothing", "command", "proof", "late", "neutral", "zeros", "higher", "equal", "senders"
    ]
    source: str = ""
    """The source that must send a zero, must prove its clock, sends only zeros, or has the
    robot."""
    seconds: float = 0.0
    """Seconds without a speed after the zero of a shared identity, or seconds of a proof."""
    senders: int = 0
    """Number of senders that wait while another sender of the same source is followed."""
    lasts: float = 0.0
    """Least duration of the wait, s, in coarse steps, so that it does not change with each step."""
    kept: str = ""
    """The source that sends speeds meanwhile and is kept waiting."""
    ros: bool = False
    """Whether the sender that must send a zero uses ROS."""
    shared: bool = False
    """Whether several programs may share the identity of the sender that must send a zero."""


class SourceStatus(Struct, frozen=True):
    """The state of one source; `age_s` since its last accepted command, None before the first."""

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait


class WheelsStatus(Struct, frozen=True):
    """Wheel faults, slip and slow wheels. Empty while the wheels agree and obey."""

    text: str = ""
    """The trouble in words."""
    left_out: tuple[str, ...] = ()
    """The names of the wheels that the pose ignores."""
    slipping: tuple[str, ...] = ()
    """The sides that slip, `left` and `right`, now or within the last half second."""
    differ: tuple[float, float] = (0.0, 0.0)
    """Learned shares by which the front wheel turns more than the rear one, left and right."""
    slow: tuple[str, ...] = ()
    """The wheels that turn the right way, but too slowly, each with its share of the expected
    speed."""


class RoutersStatus(Struct, frozen=True):
    """The connections of `bus.connect`. All fields are empty if `bus.connect` is empty."""

    connected: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    """Connected endpoints that are not routers and so forward nothing."""


class GyroSample(Struct, frozen=True, omit_defaults=True):
    """A turn rate about base_link's z axis by a gyro.

    `rate` is in rad/s, left is +. `variance` is in rad2/s2, 0 if the gyro does not report it.
    `anew` marks the first sample of another gyro.
    """

    at_ns: int
    """Monotonic time of its arrival."""
    stamp_ns: int | None
    """Time of the measurement by the sender's clock, None if the sample has no stamp."""
    rate: float
    variance: float = 0.0
    anew: bool = False


GyroDoes = Literal[
    "off", "waiting for rest", "used", "silent", "disagrees",
    "reversed", "in degrees", "dead", "not believed",
]  # fmt: skip
"""The state of the gyro. In `used` and `disagrees` (the wheels slip) it gives the heading."""

TrackUse = Literal["shown", "uncertain", "too far off", "used"]
"""The use of the track learned from a gyro. Unless `used`, the configured track is in use."""


class GyroStatus(Struct, frozen=True):
    """The state of the gyro, and the results about it; None where one is not known yet."""

    does: GyroDoes = "off"
    bias: float | None = None
    """Bias, rad/s."""
    delay: float = 0.0
    """Delay of the gyro relative to the wheels, s."""
    track: float | None = None
    track_deviation: float = 0.0
    """Learned effective track as a share of the configured one, and its relative deviation."""
    track_use: TrackUse = "shown"


EstopState = Literal["", "released", "pressed", "silent"]
"""The state of the emergency-stop input; "" if the board has never reported it. `silent` means that
the board no longer reports it, which counts as pressed."""


BatteryLevel = Literal["ok", "warning", "return", "stop", "unknown"]
"""The level of the battery by the thresholds in `[battery]`; "ok" if none is set. `unknown` means
that the board no longer reports the battery, or does not report what the thresholds compare."""


class BatteryStatus(Struct, frozen=True, gc=False):
    """The battery as the board reports it. None stands for a value that it does not report now."""

    level: BatteryLevel
    reported_ns: int | None = None
    """Monotonic time of the last report, ns."""
    volts: float | None = None
    percent: float | None = None
    """State of charge, 0 to 100."""
    amps: float | None = None
    """Current, A. It is negative while the battery discharges."""
    mean: float | None = None
    """The mean that the thresholds are compared with, V or %."""


class Latch(Struct, frozen=True):
    """One latch: a stop, a fault or the robot being switched off."""

    number: int
    """Identifies the latch: milliseconds since 1970, or more if the latch before has this number.

    It stays unique across restarts, and JavaScript represents it exactly.
    """
    at_ns: int
    """Wall-clock time at which the latch was set, ns since 1970."""
    by: str
    """Client that asked for it, as in `Event.by`; empty for a fault."""
    why: str
    """Reason in words: "stopped by NAME", the fault's reason or "switched off by NAME"."""
    kept: bool = False
    """True if the latch was set before the daemon's last start."""


class Latches(Struct, frozen=True):
    """Everything that must survive every end of the process; it does not depend on the link."""

    stop: Latch | None = None
    fault: Latch | None = None
    inactive: Latch | None = None
    lowered: dict[str, float] = {}
    """Each `limits.*` setting that `set` made lower than in the configuration file, by its key."""

    @property
    def next(self) -> Latch | None:
        """The latch that `clear` releases next: the fault if there is one, else the stop."""
        return self.fault or self.stop

    @property
    def in_force(self) -> Latch | None:
        """The latch that decides the mode: the fault, else the stop, else `inactive`."""
        return self.next or self.inactive

    def after_restart(self) -> Latches:
        """Return these latches for the next start of the daemon, each marked as kept."""
        stop, fault, inactive = (
            None if latch is None else replace(latch, kept=True)
            for latch in (self.stop, self.fault, self.inactive)
        )
        return Latches(stop, fault, inactive, self.lowered)


class Inputs(Struct, frozen=True):
    """Everything that one step may know.

    With `tick` the line of the period leaves in this step. With `at_once` a line may leave if the
    command is new. With neither, the step only uses feedback. `opened` counts the openings of the
    port: a new number is a new session with the board.
    """

    now: Instant
    tick: bool
    port_open: bool
    opened: int = 0
    port_trouble: str = ""
    """Why the port is closed, in words."""
    received: tuple[Received, ...] = ()
    commands: tuple[Command, ...] = ()
    requests: tuple[Request, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    """The messages from the bus that were refused before they became a `Command`."""
    guard_trip: str = ""
    """Why the guard replaced the previous line with STOP, which latches a fault."""
    superseded: bool = False
    """Whether the line of the step before did not leave and so had no effect."""
    missed: int = 0
    """Number of periods without a step since the step before."""
    events: tuple[Event, ...] = ()
    """Events of the shell, to be logged together with those of the robot."""
    at_once: bool = False
    shutting_down: bool = False
    """Whether the daemon is going down. The robot then ramps to zero and stays there."""
    late_ns: int = 0
    """How much later than its step the last line left, ns. 0 if the process ran on without a
    stall."""


class Outputs(Struct, frozen=True):
    """Everything that one step decided."""

    now: Instant
    due: bool
    """Whether the step had a line to send, for its period or at once."""
    line: bytes | None
    """The line for the board, None if none is due."""
    speeds: WheelSpeeds
    applied: Twist
    linked: bool
    estimates: tuple[Estimate, ...]
    mode: str
    reason: str
    """Why the robot moves or does not, in words."""
    link: str
    source: str
    """The source whose command is followed, "" without one."""
    command_ns: int | None
    """Monotonic arrival of the command that is followed, None without one."""
    status_changed: bool
    """Whether `mode`, `reason`, `link`, `source` or the battery's level differs from the step
    before."""
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    news: bool = False
    """Whether the followed command or the mode has changed since the last line that was due."""
    latches: Latches = Latches()
    """The latches in force after the step; the same object until one of them changes."""


class Spread(Struct, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, in one unit."""

    count: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Measured(Struct, frozen=True):
    """One of the daemon's own latencies, us."""

    since_start: Spread = Spread()
    last_minute: Spread = Spread()


class Recording(Struct, frozen=True):
    """The state of the black box."""

    where: str = ""
    """The directory, "" if nothing is recorded."""
    trouble: str = ""
    """Why recording fails at present, in words."""
    missing: int = 0
    """Number of steps that were not recorded."""


class Snapshot(Struct, frozen=True):
    """Values for `state` and `diagnostics` beyond one step's outputs."""

    pose: Pose
    measured: Twist | None  # None while the feedback is silent
    speeds: WheelSpeeds | None  # None while the feedback is silent
    sources: tuple[SourceStatus, ...]
    counters: dict[str, int]
    refused: str
    """The last command that was refused and the reason, "" before the first one."""
    refused_age_s: float | None = None
    """Seconds since a command was refused for any reason except a new sender, None before that."""
    feedback_age_s: float | None = None  # since the last good line, None before it
    missed_last_minute: int = 0
    """Number of periods without a step in the last minute."""
    figures: dict[str, Measured] = {}
    """The daemon's own latencies, by the names in `daemon/latencies.py`."""
    gyro: GyroStatus = GyroStatus()
    doubt: WheelsStatus = WheelsStatus()
    estop: EstopState = ""
    bumpers: tuple[bool, ...] | None = None
    """Whether each bumper counts as pressed, in the order of the board, None if never reported."""
    bumper: str = ""
    """Why a bumper counts as pressed, in words; "" while none does."""
    battery: BatteryStatus | None = None
    """The battery, None if the board has never reported it."""
    board: dict[str, str] = {}
    """The fields of the board's last status line, by name, as text."""
    check: str = "plain"
    """The check of the serial lines, in words."""
    encoders: tuple[int, ...] = ()
    """Counts per turn that the lines show, in `WHEELS` order; 0 if unknown."""
    sender: str = ""
    """The sender whose command is followed, "" without one."""
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    latch_file: str | None = None
    """Why the latches would not survive a restart, in words; None if nothing is kept."""
