"""The value types that all modules share, in SI units and with the wheel order `WHEELS`.

This module reads no clock, does no I/O and decides nothing. For speed, Python's garbage collector
ignores the types with `gc=False`; they are never part of a reference cycle.
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
    """One moment, by the monotonic clock and by the wall clock, ns.

    Ages and periods are computed from `mono_ns`. The stamps of messages come from `wall_ns`.
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
    """The bytes that one read of the serial port returned, and the moment of this read."""

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
    """Number that the sender gave to this command; None if the sender does not number its commands.
    A missing number means that a command was lost."""
    shared: bool = False
    """Whether several programs may have the same `sender`, because the command contains neither a
    sender id nor a GID. Then `sender` names only the Zenoh session that stamped the command, which
    may be the session of a router or a bridge, or only the key."""
    ros: bool = False
    """Whether the command came from ROS. Some ROS tools never send a zero. If such a tool must send
    one, the text about the wait says so."""
    stamp_replaced: bool = False
    """Whether Zenoh replaced the stamp, because the sender's clock is ahead of the daemon's."""
    steady: bool = False
    """Whether the sender declares that the clock of its stamps is never adjusted."""


Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

Plain = bool | int | float | str | list[float | str]
"""The value of a setting, as a client writes it."""


class Request(Struct, frozen=True):
    """A service call, or a stop that was published on the bus.

    `id` is the ticket of the query that the robot must answer; 0 for a stop that is no query.
    """

    verb: Verb
    id: int = 0
    pose: Pose | None = None
    asked_ns: int | None = None
    """Monotonic time at which the request arrived, ns. None means the time of the control step that
    serves the request. A `clear` does not release a stop that came after this time."""
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
    """A client's message that was refused.

    `text` explains the refusal. The robot adds 1 to the counter `command_<reason>`, or to
    `commands_of_new_senders` if the reason is `unproven`. `source` and `sender` are "" if they are
    unknown.
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
    """A finer distinction than `name`, such as the reason of a refusal. A log line that combines
    several events states the number of events of each kind."""
    count: int = 1
    """Number of occurrences that this event stands for."""
    news: bool = True
    """False if the event only repeats an earlier one. The log line of such an event may be
    delayed."""


class Estimate(Struct, frozen=True, gc=False):
    """The estimate that the odometry computes from one feedback line, valid at the time `at`."""

    at: Instant
    pose: Pose
    twist: Twist
    covariance: PoseCovariance
    twist_variances: TwistVariances
    positions: tuple[float, float, float, float]
    """Angle by which each wheel has turned since the daemon started, rad, in `WHEELS` order. The
    angle is not wrapped: each full turn forward adds 2 pi."""
    speeds: WheelSpeeds
    asked_ns: int | None = None
    """Monotonic time at which the daemon wrote the command line that the feedback line answers, ns.
    None if the daemon does not know which command line that is."""
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
    """The source that the condition `what` is about; "" if the condition is not in this list.

    - neutral: The waiting source, which must send a zero.
    - proof: The waiting source, which must show that its delays are steady.
    - late: The waiting source, whose commands arrive too late.
    - stalled: The waiting source, which has sent no command since the last host stall.
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
    """Time for which the source has sent speeds without a zero (if `what` is `neutral`), or only
    zeros (if `what` is `zeros`), s. It is rounded down to one of a few values, so that the text
    about the wait seldom changes. It is 0 for a shorter time, and for all other conditions."""
    kept: str = ""
    """Name of a source that sends speeds without effect, because `self.source` controls the robot
    and sends only zeros. It is "another sender of NAME" if both senders belong to the source NAME,
    and "" if no sender is kept from driving in this way."""
    ros: bool = False
    """Whether the sender that must send a zero uses ROS."""
    shared: bool = False
    """Whether several programs may share the identity of the sender that must send a zero."""


class SourceStatus(Struct, frozen=True):
    """A command source.

    `age_s` is the time since the last accepted command of the source, s. After some events, such as
    the start or a `clear`, each sender must first command zero speed. From such an event until the
    next accepted command, the age is None.
    """

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait


class WheelsStatus(Struct, frozen=True):
    """Wheel faults, slip and slow wheels.

    If the checks find nothing wrong, all fields except `differ` are empty.
    """

    text: str = ""
    """Description of the faults and the slip, "" if there are none."""
    left_out: tuple[str, ...] = ()
    """The names of the wheels that the odometry ignores."""
    slipping: tuple[str, ...] = ()
    """The sides, `left` or `right`, whose wheels have slipped within the last half second."""
    differ: tuple[float, float] = (0.0, 0.0)
    """Learned difference between the front and the rear wheel, for the left and for the right side.
    0.01 means that the front wheel rolls 1 % farther than the rear wheel."""
    slow: tuple[str, ...] = ()
    """A text for each wheel that is slower than commanded, such as "front_left 60%" if it reaches
    60 % of the expected speed."""


class RoutersStatus(Struct, frozen=True):
    """The endpoints in `bus.connect`: those that are connected, and those that are missing."""

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
"""`used` if the odometry uses the effective track that it has learned from a gyro, else the reason
why not. `shown` means that `odometry.learned_track` is false. The effective track is the
distance between left and right wheels with which the computed turns are true."""


class GyroStatus(Struct, frozen=True):
    """The state of the gyro and the values learned from it. A value not known yet is None."""

    does: GyroDoes = "off"
    bias: float | None = None
    """Turn rate that the gyro reports at rest, rad/s."""
    delay: float = 0.0
    """Time by which the gyro reports a turn later than the wheels, s; negative if it is earlier."""
    track: float | None = None
    """Learned effective track divided by the configured one."""
    track_deviation: float = 0.0
    """Relative standard deviation of `track`."""
    track_use: TrackUse = "shown"


EstopState = Literal["", "released", "pressed", "silent"]
"""The state of the emergency-stop input; "" if the board has never reported it. `silent` means that
the board no longer reports it, which counts as pressed."""


BatteryLevel = Literal["ok", "warning", "return", "stop", "unknown"]
"""The level of the battery by the thresholds in `[battery]`; `ok` if no threshold is set. `unknown`
means that the daemon cannot tell the level: the board does not report the value that the thresholds
are for (voltage or charge), or has begun to report it only a few seconds ago."""


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
    """The value that is compared with the thresholds: the voltage (V) or the charge (%), averaged
    over about 10 s."""


class Latch(Struct, frozen=True):
    """One latch: a stop, a fault or the robot being switched off."""

    number: int
    """Identifies the latch, also after a restart. The number is the time at which the latch was
    set, ms since 1970. If this time is not later than the number of an earlier latch, a larger
    number is used, so that numbers always grow. JavaScript represents the number exactly."""
    at_ns: int
    """Wall-clock time at which the latch was set, ns since 1970."""
    by: str
    """Name of the client that requested the latch; "" if no client did, as for a fault."""
    why: str
    """Reason in words, such as "stopped by NAME" or the cause of a fault."""
    kept: bool = False
    """True if the latch was set before the daemon's last start."""
    earlier: tuple[Latch, ...] = ()
    """The latches with the earlier causes of the same stop, the newest first. A latch moves to this
    tuple when a later cause replaces it. The field `earlier` of these latches is empty."""

    @property
    def causes(self) -> tuple[Latch, ...]:
        """This latch, and the latches with the earlier causes of the same stop, newest first."""
        return (self, *self.earlier)

    def each(self, change: Callable[[Latch], Latch]) -> Latch:
        """Apply `change` to this latch and to each latch in `earlier`; return the changed latch.

        The function `change` gets one latch and returns its replacement.
        """
        return replace(change(self), earlier=tuple([change(cause) for cause in self.earlier]))


class Latches(Struct, frozen=True):
    """The latches and the lowered limits, which must be kept even if the process is killed."""

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
        """Return a copy for the next start of the daemon, in which each latch has `kept = True`."""
        stop, fault, inactive = (
            None if latch is None else latch.each(lambda cause: replace(cause, kept=True))
            for latch in (self.stop, self.fault, self.inactive)
        )
        return Latches(stop, fault, inactive, self.lowered)


class Inputs(Struct, frozen=True):
    """The complete input of one control step.

    - tick: True if the step must compute the line of a control period.
    - at_once: True if the step may compute an extra line for a new command or mode.
    - opened: Number of times that the serial port was opened. If the number has grown, the step
      begins a new session with the board.
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
    """Why the guard replaced the previous line with zeros, in words; "" if it did not. Such a
    replacement latches a fault."""
    superseded: bool = False
    """True if the line of the previous step was not written to the port, so it had no effect."""
    missed: int = 0
    """Number of control periods without a step since the previous step."""
    events: tuple[Event, ...] = ()
    """Events of other parts of the daemon, to be logged together with the robot's events."""
    at_once: bool = False
    shutting_down: bool = False
    """Whether the daemon is going down. The robot then ramps to zero and stays there."""
    late_ns: int = 0
    """Time from the start of the previous step until its line was written, ns. A time
    below 1 ms is stored as 0. A longer time means that the process has stalled in between."""


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
    """Why the robot moves, or why it does not move, in words."""
    link: str
    source: str
    """The source that the arbiter has selected, "" if it has selected none. The source may still
    have to send a zero, or a latch may keep the robot from driving."""
    command_ns: int | None
    """Monotonic time at which the selected command arrived, ns; None if no command is selected."""
    status_changed: bool
    """Whether `mode`, `reason`, `link`, `source` or the battery's level changed in this step."""
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    news: bool = False
    """Whether an extra line is useful. This is true if the command or the mode has changed since
    the last computed line, or if the emergency stop or a bumper was pressed."""
    latches: Latches = Latches()
    """The latches and lowered limits after the step. If this is not the same object as in the
    previous step, a latch or a lowered limit has changed."""


class Spread(Struct, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, in the measurements' unit."""

    count: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Measured(Struct, frozen=True):
    """Statistics, us, of one latency of the daemon, such as the time from a command to its line."""

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
    """Values for the messages `state` and `diagnostics` that are not in `Outputs`."""

    pose: Pose
    measured: Twist | None  # None while the feedback is silent
    speeds: WheelSpeeds | None  # None while the feedback is silent
    sources: tuple[SourceStatus, ...]
    counters: dict[str, int]
    refused: str
    """The last command that was refused and the reason, "" before the first one."""
    refused_age_s: float | None = None
    """Seconds since a command was last refused, None if none was refused yet. A command that is
    refused only because its sender is new does not count."""
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
    """Whether each bumper counts as pressed, in the order in the board's reports. None if the board
    has never reported its bumpers."""
    bumper: str = ""
    """Why a bumper counts as pressed, in words; "" while none does."""
    battery: BatteryStatus | None = None
    """The battery, None if the board has never reported it."""
    board: dict[str, str] = {}
    """Maps the name of each field of the board's status lines to its last value, as text. The entry
    `age_s` is the age of the last status line, s. The map is empty before the first status line."""
    check: str = "plain"
    """Whether the serial lines carry a checksum, in words, such as "plain" or "checked"."""
    encoders: tuple[int, ...] = ()
    """Configured encoder counts per wheel turn, in `WHEELS` order. All are 0 if no counts are
    configured. They are also 0 if the reported speeds do not match the configured counts: each
    speed should be an integer number of counts divided by a time."""
    sender: str = ""
    """The sender that the arbiter has selected, "" if it has selected none."""
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    latch_file: str | None = None
    """Why the latches would be lost if the daemon restarted now, in words. "" if they would be
    kept; None if this daemon has no latch file."""
