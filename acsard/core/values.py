"""The value types that all modules share, in SI units and with the wheel order `WHEELS`.

This module reads no clock, does no I/O and decides nothing. Types with `gc=False` are never part of
a reference cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
"""The order of every four-wheel value, index 0 to 3."""

NS_PER_S = 1_000_000_000

ROOT = "acsard"
"""The first part of every native (non-ROS) key: `acsard/<robot.id>/...`."""

Role = Literal["viewer", "operator", "maintainer"]
"""Role of a client on the bus. Each role has the permissions of the roles before it."""

ROLES: tuple[Role, ...] = get_args(Role)


class AcsardError(Exception):
    """Base of the errors that acsard raises on purpose. Any other exception is a bug."""


class Instant(Struct, frozen=True, gc=False):
    """One moment, as two clocks show it.

    Ages and periods are computed from the monotonic clock. Stamps come from the wall clock.
    """

    mono_ns: int
    wall_ns: int


class Twist(Struct, frozen=True, gc=False):
    """Velocity of base_link: `linear` along x, m/s, and `angular` about z to the left, rad/s."""

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
    """Variances of the twist that one feedback line gives, in base_link.

    `linear` and `lateral` are in m2/s2, `angular` is in rad2/s2.
    """

    linear: float
    lateral: float
    angular: float


class Received(Struct, frozen=True):
    """The bytes that one read of the serial port returned, and the time of the read."""

    at: Instant
    data: bytes


class Command(Struct, frozen=True):
    """A velocity that one sender requests.

    - source: one of `commands.sources`, such as `app` for the key `cmd/app`.
    - sender: public name of the program that sent the command, as far as it is known.
    - arrived_ns: monotonic time of arrival, ns. The command's age is computed from this time alone.
    - stamp_ns: time of sending, ns, by a clock that is not synchronized with the daemon's clock.
    - clock: name of the clock that gave `stamp_ns`.
    """

    source: str
    twist: Twist
    arrived_ns: int
    stamp_ns: int | None = None
    clock: str = ""
    sender: str = ""
    cancelled: bool = False
    """Whether `twist` is zero only because the robot cannot make the requested motion, for example
    a motion along y. Such a command does not count as the zero that a sender must send first."""
    sequence: int | None = None
    """Number that the sender gave to this command, or None. A gap in the numbers of a sender means
    that commands were lost."""
    shared: bool = False
    """Whether several programs may have the same `sender`, because the command contains neither a
    sender id nor a GID. Then `sender` names only the Zenoh session that stamped the command, which
    may be the session of a router or a bridge, or only the key."""
    ros: bool = False
    """Whether the command came from ROS. ROS tools do not send a zero command by themselves."""
    stamp_replaced: bool = False
    """Whether Zenoh replaced the stamp, because the sender's clock is ahead of the daemon's."""
    steady: bool = False
    """Whether the sender declares that the clock of its stamps is never adjusted."""


Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

Plain = bool | int | float | str | list[float | str]
"""The value of a setting, as a client writes it."""


class Request(Struct, frozen=True):
    """A service call or a stop. `id` is the ticket of the query to answer, 0 without a query."""

    verb: Verb
    id: int = 0
    pose: Pose | None = None
    asked_ns: int | None = None
    """Monotonic time at which the request arrived, ns. None means the time of the control step that
    serves the request. A `clear` needs this time, because it must not release a later stop."""
    by: str = ""
    """Name of the client that sent the request, as `core/incoming/commands.py` forms it."""
    settings: dict[str, Plain] = {}
    """The new values of the settings that `set` changes, by dotted key ("limits.linear_speed")."""
    latch: int | None = None
    """Number of the latch that `clear` or `activate` releases; None if the client names none."""


class Answer(Struct, frozen=True):
    """The result of the `Request` with the same `id`."""

    id: int
    success: bool
    message: str


class Refusal(Struct, frozen=True):
    """A message of a client that was refused.

    The robot counts it as `command_<reason>`, or as `commands_of_new_senders` for the reason
    `unproven`. `source` and `sender` are "" if they are unknown.
    """

    reason: str
    text: str
    source: str = ""
    sender: str = ""
    arrived_ns: int = 0
    """Monotonic time at which the command arrived, ns; 0 if it is unknown."""
    shared: bool = False
    """Whether several programs may have the same `sender` (see `Command.shared`)."""


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

    `event_throttle.py` joins frequent events that have the same name into one log line per second.
    """

    name: EventName
    text: str
    level: Level = "info"
    by: str = ""
    """Name of the client that caused the event, "" if no client did."""
    kind: str = ""
    """A detail, such as the reason of a refusal. A log line that combines several events counts
    them by kind."""
    count: int = 1
    """Number of occurrences that this event stands for."""
    news: bool = True
    """False for an event that only repeats an earlier one. Its log line may be delayed."""


class Estimate(Struct, frozen=True, gc=False):
    """The estimate that the odometry computes from one feedback line, valid at the time `at`."""

    at: Instant
    pose: Pose
    twist: Twist
    covariance: PoseCovariance
    twist_variances: TwistVariances
    positions: tuple[float, float, float, float]
    """Angle that each wheel has rolled since the daemon started, rad, in `WHEELS` order. Each full
    revolution adds 2 pi."""
    speeds: WheelSpeeds
    asked_ns: int | None = None
    """Monotonic time at which the daemon wrote the line that the feedback answers, ns. None if the
    daemon does not know which line that is."""
    heard_ns: int = 0
    """Monotonic time, ns, at which the daemon had received the complete feedback line."""


class Wait(Struct, frozen=True):
    """The condition that a command source waits for before it drives the robot.

    `arbiter_text.py` makes a sentence of it.
    """

    what: Literal[
        "nothing",
        "command",
        "proof",
        "late",
        "stalled",
        "neutral",
        "zeros",
        "higher",
        "equal",
        "senders",
    ]
    source: str = ""
    """The source that the condition `what` is about; "" for each condition that is not listed here.

    - neutral: The waiting source, which must send a zero.
    - proof: The waiting source, which must show that its delays are steady.
    - late: The waiting source, whose commands arrive too late.
    - stalled: The waiting source, which has sent no command since the daemon stood still.
    - zeros: The source that controls the robot, but sends only zeros.
    - higher, equal: The source that controls the robot with a higher or an equal priority.
    """
    seconds: float = 0.0
    """A duration, s, whose meaning depends on `what`.

    - neutral: After its zero, a sender with a shared identity must send no speed for this time.
    - proof: The delays of the commands must be steady for this time.
    - late: The commands arrive with a delay that is longer than this time.
    """
    senders: int = 0
    """Number of senders that wait while the robot follows another sender of the same source."""
    lasts: float = 0.0
    """How long the source has sent speeds without a zero (`neutral`) or only zeros (`zeros`), s.
    The time is rounded down to one of a few values, so that the reason of the mode seldom changes.
    It is 0 below the smallest of these values, and for other conditions."""
    kept: str = ""
    """Name of a source whose speeds have no effect, because `self.source` controls the robot and
    sends only zeros; "" if there is no such source. If both senders belong to the same source, the
    text is "another sender of NAME"."""
    ros: bool = False
    """Whether the sender that must send a zero uses ROS."""
    shared: bool = False
    """Whether several programs may share the identity of the sender that must send a zero."""


class SourceStatus(Struct, frozen=True):
    """A command source.

    `age_s` is the time since the last accepted command of the source. It is None if no command was
    accepted since each sender was last required to send a zero, for example after a `clear`.
    """

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait


class WheelsStatus(Struct, frozen=True):
    """Wheel faults, slip and slow wheels. If there are none, every field but `differ` is empty."""

    text: str = ""
    """Description of the faults and the slip, "" if there are none."""
    left_out: tuple[str, ...] = ()
    """The names of the wheels that the odometry ignores."""
    slipping: tuple[str, ...] = ()
    """Each side, `left` or `right`, whose wheels slip or slipped within the last half second."""
    differ: tuple[float, float] = (0.0, 0.0)
    """Learned fraction by which the front wheel rolls farther than the rear wheel, for the left
    side and for the right side. 0.01 means 1 % farther."""
    slow: tuple[str, ...] = ()
    """Wheels that are slower than commanded, each with its share of the expected speed, such as
    "front_left 60%"."""


class RoutersStatus(Struct, frozen=True):
    """The endpoints in `bus.connect`, by the state of the daemon's connection to each of them."""

    connected: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    """Connected endpoints that are peers, not routers, so they do not forward messages."""


class GyroSample(Struct, frozen=True, omit_defaults=True):
    """A turn rate about base_link's z axis, measured by a gyro.

    `rate` is in rad/s and positive to the left. `variance` is in rad2/s2, or 0 if the gyro does not
    report it. `anew` is true for the first sample after a change from one gyro to another.
    """

    at_ns: int
    """Monotonic time at which the sample arrived, ns."""
    stamp_ns: int | None
    """Time of the measurement by the sender's clock, ns; None if the sample has no stamp."""
    rate: float
    variance: float = 0.0
    anew: bool = False


GyroDoes = Literal[
    "off", "waiting for rest", "used", "silent", "disagrees",
    "reversed", "in degrees", "dead", "not believed",
]  # fmt: skip
"""The state of the gyro. The odometry takes the heading from the gyro only in the states `used` and
`disagrees`. `disagrees` means that the wheels slip."""

TrackUse = Literal["shown", "uncertain", "too far off", "used"]
"""Whether the odometry uses the effective track that it learned from a gyro, or why it does not.
The effective track is the distance between left and right wheels that gives the true turn."""


class GyroStatus(Struct, frozen=True):
    """The state of the gyro and the values learned from it. A value not known yet is None."""

    does: GyroDoes = "off"
    bias: float | None = None
    """Turn rate that the gyro reports at rest, rad/s."""
    delay: float = 0.0
    """Delay of the gyro relative to the wheels, s."""
    track: float | None = None
    """Learned effective track as a share of the configured one."""
    track_deviation: float = 0.0
    """Relative standard deviation of `track`."""
    track_use: TrackUse = "shown"


EstopState = Literal["", "released", "pressed", "silent"]
"""The state of the emergency-stop input; "" if the board has never reported it. `silent` means that
the board no longer reports it, which counts as pressed."""


BatteryLevel = Literal["ok", "warning", "return", "stop", "unknown"]
"""The level of the battery by the thresholds in `[battery]`; "ok" if no threshold is set. `unknown`
means that the board does not report the value that is compared with the thresholds (V or %), or has
reported it only for a few seconds so far."""


class BatteryStatus(Struct, frozen=True, gc=False):
    """The battery as the board reports it. A value that the board does not report now is None."""

    level: BatteryLevel
    reported_ns: int | None = None
    """Monotonic time of the last report, ns; None while the board does not report its battery."""
    volts: float | None = None
    percent: float | None = None
    """State of charge, 0 to 100."""
    amps: float | None = None
    """Current, A. It is negative while the battery discharges."""
    mean: float | None = None
    """Voltage (V) or charge (%), averaged over about 10 s, that is compared with the thresholds."""


class Latch(Struct, frozen=True):
    """One latch: a stop, a fault or the robot being switched off."""

    number: int
    """Identifies the latch, also after a restart. The number is the time at which the latch was
    set, ms since 1970. It is larger if an earlier latch already has that number or a larger one.
    JavaScript represents the number exactly."""
    at_ns: int
    """Wall-clock time at which the latch was set, ns since 1970."""
    by: str
    """Name of the client that requested the latch; "" if no client did, as for a fault."""
    why: str
    """Reason in words, such as "stopped by NAME" or the cause of a fault."""
    kept: bool = False
    """True if the latch was set before the daemon's last start."""
    earlier: tuple[Latch, ...] = ()
    """The earlier causes of the same stop, the newest first. Each of them is a latch that a later
    cause replaced. The field `earlier` of such a latch is empty."""

    @property
    def causes(self) -> tuple[Latch, ...]:
        """This latch and the earlier causes of the same stop, the newest first."""
        return (self, *self.earlier)

    def each(self, change: Callable[[Latch], Latch]) -> Latch:
        """Return this latch with `change` applied to it and to each earlier cause."""
        return replace(change(self), earlier=tuple([change(cause) for cause in self.earlier]))


class Latches(Struct, frozen=True):
    """The latches and the lowered limits, which must survive every end of the daemon's process."""

    stop: Latch | None = None
    fault: Latch | None = None
    inactive: Latch | None = None
    lowered: dict[str, float] = {}
    """The `limits.*` settings that `set` made lower than in the configuration file, by key."""

    @property
    def next(self) -> Latch | None:
        """The latch that `clear` releases next: the fault, else the stop, else None."""
        return self.fault or self.stop

    @property
    def in_force(self) -> Latch | None:
        """The latch that decides the mode: the fault, else the stop, else `inactive`, else None."""
        return self.next or self.inactive

    def after_restart(self) -> Latches:
        """Return these latches for the next start of the daemon, each marked as kept."""
        stop, fault, inactive = (
            None if latch is None else latch.each(lambda cause: replace(cause, kept=True))
            for latch in (self.stop, self.fault, self.inactive)
        )
        return Latches(stop, fault, inactive, self.lowered)


class Inputs(Struct, frozen=True):
    """The complete input of one control step.

    If `tick` is true, the step computes the line of a control period. If `at_once` is true, the
    step may compute an extra line for a new command or mode. `opened` is the number of times that
    the serial port was opened: a new number means a new session with the board.
    """

    now: Instant
    tick: bool
    port_open: bool
    opened: int = 0
    port_trouble: str = ""
    """Why the serial port is closed, in words; "" while it is open."""
    received: tuple[Received, ...] = ()
    commands: tuple[Command, ...] = ()
    requests: tuple[Request, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    """The messages from the bus that were refused before they became a `Command`."""
    guard_trip: str = ""
    """Why the guard replaced the last line with STOP, which latches a fault; "" if it did not."""
    superseded: bool = False
    """Whether the line of the previous step was not written to the port, and so had no effect."""
    missed: int = 0
    """Number of control periods without a step since the previous step."""
    events: tuple[Event, ...] = ()
    """Events of other parts of the daemon, to be logged together with the robot's events."""
    at_once: bool = False
    shutting_down: bool = False
    """Whether the daemon is going down. The robot then ramps to zero and stays there."""
    late_ns: int = 0
    """Time from the start of the previous step until its line was written, ns. A time below 1 ms
    counts as 0. Longer times mean that the process has stalled."""


class Outputs(Struct, frozen=True):
    """Everything that one control step decided."""

    now: Instant
    due: bool
    """Whether this step had to compute a line for the board: the line of a control period, or an
    extra line for a new command or mode."""
    line: bytes | None
    """The line for the board; None if no line was due."""
    speeds: WheelSpeeds
    applied: Twist
    linked: bool
    estimates: tuple[Estimate, ...]
    mode: str
    reason: str
    """Why the robot moves or does not, in words."""
    link: str
    source: str
    """The source that the arbiter has selected, "" if it has selected none. The source may still
    have to send a zero, or a latch may keep the robot from driving."""
    command_ns: int | None
    """Monotonic arrival time of the selected command, ns; None if no sender may drive."""
    status_changed: bool
    """Whether `mode`, `reason`, `link`, `source` or the battery's level changed in this step."""
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    news: bool = False
    """Whether there is a reason for an extra line: since the last computed line, the command or the
    mode has changed, or the emergency stop or a bumper was pressed."""
    latches: Latches = Latches()
    """The latches in force after the step. A new object means that a latch or a lowered limit has
    changed."""


class Spread(Struct, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, in the measurements' unit."""

    count: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Measured(Struct, frozen=True):
    """Statistics of one latency of the daemon, in us."""

    since_start: Spread = Spread()
    last_minute: Spread = Spread()


class Recording(Struct, frozen=True):
    """The state of the recorder, which stores every control step in files."""

    where: str = ""
    """The directory of the recordings, "" if recording is switched off."""
    trouble: str = ""
    """Why recording fails at present, in words; "" if it does not fail."""
    missing: int = 0
    """Number of steps that were not recorded."""


class Snapshot(Struct, frozen=True):
    """The values in the messages `state` and `diagnostics` that `Outputs` does not contain."""

    pose: Pose
    measured: Twist | None  # None while the feedback is silent
    speeds: WheelSpeeds | None  # None while the feedback is silent
    sources: tuple[SourceStatus, ...]
    counters: dict[str, int]
    refused: str
    """The last command that was refused and the reason, "" before the first one."""
    refused_age_s: float | None = None
    """Seconds since the last refused command, None before the first one. A command that is refused
    only because its sender is new does not count."""
    feedback_age_s: float | None = None
    """Seconds since the last valid line of the board, None before the first one."""
    missed_last_minute: int = 0
    """Number of control periods in the last minute in which no control step ran."""
    figures: dict[str, Measured] = {}
    """The latencies of the daemon, by the names in `daemon/latencies.py`."""
    gyro: GyroStatus = GyroStatus()
    doubt: WheelsStatus = WheelsStatus()
    estop: EstopState = ""
    bumpers: tuple[bool, ...] | None = None
    """Whether each bumper counts as pressed, in the order of the board; None if never reported."""
    bumper: str = ""
    """Why a bumper counts as pressed, in words; "" while none does."""
    battery: BatteryStatus | None = None
    """The battery, None if the board has never reported it."""
    board: dict[str, str] = {}
    """The last value of each field of the board's status lines, as text, by name. `age_s` is the
    age of the last status line, s. Empty if the board has sent no status line."""
    check: str = "plain"
    """Whether the serial lines carry a checksum, in words, such as "plain" or "checked"."""
    encoders: tuple[int, ...] = ()
    """Configured encoder counts per wheel revolution, in `WHEELS` order. 0 if none is configured,
    or if the board does not compute its speeds as a whole number of counts divided by a time."""
    sender: str = ""
    """The sender that the arbiter has selected, "" if it has selected none."""
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    latch_file: str | None = None
    """Why the latches would not survive a restart, in words; "" if they would. None if this daemon
    has no latch file."""
