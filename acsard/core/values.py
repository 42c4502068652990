"""The value types that all modules share, in SI units and with the wheel order `WHEELS`.

This module reads no clock, does no I/O and decides nothing. Types with `gc=False` are ignored by
Python's garbage collector, which saves time. They are never part of a reference cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, get_args

from msgspec import Meta, Struct
from msgspec.structs import replace

from acsard.core.codes import Code, GuardCode, Reason, RefusalCode, WaitCode

WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
"""Names of the wheels, in the order of every value with one item per wheel."""

# Types that name the unit and the clock of a value, so that no sentence has to.
Ns = int  # monotonic time, or a duration, ns
WallNs = int  # time since 1970 by a wall clock, ns
Seconds = float
Rad = float
RadPerS = float
Metres = float

NS_PER_S = 1_000_000_000

ROOT_KEY = "acsard"
"""The first part of every native (non-ROS) key: `acsard/<robot.id>/...`."""

Role = Literal["viewer", "operator", "maintainer"]
"""Role of a client on the bus. Each role has the permissions of the roles before it."""

ROLES: tuple[Role, ...] = get_args(Role)


class AcsardError(Exception):
    """Base of the errors that acsard raises on purpose. Any other exception is a bug."""


class Instant(Struct, frozen=True, gc=False):
    """One moment, by the monotonic clock and by the wall clock, ns.

    Ages and periods are differences of `mono_ns`. The stamps of messages come from `wall_ns`.
    """

    mono_ns: int
    wall_ns: int


class Twist(Struct, frozen=True, gc=False):
    """Velocity of base_link.

    `linear` is the speed along x, m/s. `angular` is the turn rate about z, positive to the left,
    rad/s.
    """

    linear: float = 0.0
    angular: float = 0.0


class Pose(Struct, frozen=True, gc=False):
    """Planar pose of base_link in the frame odom.

    `x` and `y` are in m, and `yaw` is in rad, from -pi to pi.
    """

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
    """Upper triangle of the covariance matrix of (x, y, yaw) in the frame odom.

    The units are m2, m rad and rad2.
    """

    xx: float
    xy: float
    xyaw: float
    yy: float
    yyaw: float
    yawyaw: float


class TwistVariances(Struct, frozen=True, gc=False):
    """Variances of the velocity of the base frame that the odometry computes from a feedback line.

    `linear` and `lateral` are in m2/s2, and `angular` is in rad2/s2.
    """

    linear: float
    lateral: float
    angular: float


class Received(Struct, frozen=True):
    """The bytes that one read of the serial port returned, and the time of this read."""

    at: Instant
    data: bytes


class Command(Struct, frozen=True):
    """A velocity that a sender requests.

    - source: name of the command source, such as `app` for the key `cmd/app`.
    - sender: public name of the program that sent the command. If the program is unknown, another
      name takes its place (see `shared`).
    - arrived_ns: monotonic time of arrival, ns. The age of the command is computed from this time
      alone.
    - stamp_ns: time of sending, ns, by a clock that is not synchronized with the daemon's clock.
      None if the command has no stamp.
    - clock: name of the clock that gave `stamp_ns`.
    """

    source: str
    twist: Twist
    arrived_ns: int
    stamp_ns: int | None = None
    clock: str = ""
    sender: str = ""
    cancelled: bool = False
    """True if `twist` is zero only because the robot cannot make the requested motion, for example
    a motion along y. Such a command does not arm its sender, although it is zero."""
    sequence: int | None = None
    """Number that the sender gave to this command; None if the sender does not number its
    commands. A gap in the numbers means that a command was lost."""
    shared: bool = False
    """True if several programs may have the same `sender`, because the command contains neither a
    sender id nor a GID. Then `sender` is only the name of the Zenoh session that stamped the
    command, or only the key. The session may belong to a router or a bridge."""
    ros: bool = False
    """True if the command came from ROS. Some ROS tools never send a zero, so a text that asks a
    ROS sender for a zero mentions this fact."""
    stamp_replaced: bool = False
    """True if Zenoh replaced the stamp, because the sender's clock is ahead of the daemon's
    clock."""
    steady: bool = False
    """True if the sender declares that the clock of its stamps is never adjusted."""


Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

Plain = (
    bool | Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)] | float | str | list[float | str]
)
"""Value of a setting in a request of a client. Integers have at most 64 bits, as in a recording."""


class Request(Struct, frozen=True):
    """A call of a service, or a stop that was published on the bus.

    `id` identifies the query to which the robot must reply. It is 0 for a stop that was published,
    because such a stop gets no reply.
    """

    verb: Verb
    id: int = 0
    pose: Pose | None = None
    asked_ns: int | None = None
    """Monotonic time at which the request arrived, ns. None means the time of the control step
    that processes the request. A `clear` does not release a stop that came after this time."""
    by: str = ""
    """Name of the client that sent the request, as `core/incoming/commands.py` forms it."""
    settings: dict[str, Plain] = {}
    """The new values for the verb `set`, by dotted key such as "limits.linear_speed"."""
    latch: int | None = None
    """Number of the latch to be released, for the verbs `clear` and `activate`. None if the client
    gives no number."""


class Answer(Struct, frozen=True):
    """The robot's answer to the `Request` with the same `id`."""

    id: int
    success: bool
    message: str
    latch: int = 0
    """Number of the latch that the request has set or released; 0 if it did neither."""
    changes: dict[str, tuple[Plain, Plain]] = {}
    """The settings that the request has changed: old and new value by dotted key."""


class Refusal(Struct, frozen=True):
    """A message from a client that the daemon refused.

    `reason` is the code, and `text` explains the refusal. The robot adds 1 to the counter
    `command_<reason>`, or to `commands_of_new_senders` if the reason is `unproven`. `source` and
    `sender` are "" if they are unknown.
    """

    reason: RefusalCode
    text: str
    source: str = ""
    sender: str = ""
    arrived_ns: int = 0
    """Monotonic time at which the message arrived, ns; 0 if this time is unknown."""
    shared: bool = False
    """True if several programs may have the same `sender` (see `Command.shared`)."""


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
    "router_open",
    Verb,
    "speed_limit",
    "mode", "commander", "commands_without_effect", "new_sender", "command_refused", "fault",
]  # fmt: skip
"""All names of events in the log. `deploy/systemd/README.md` explains each name."""

Level = Literal["info", "warning", "error"]


class Event(Struct, frozen=True):
    """An event for the log.

    If events of the same name are frequent, `event_throttle.py` joins them into about one log line
    per second.
    """

    name: EventName
    text: str
    level: Level = "info"
    by: str = ""
    """Name of the client that caused the event; "" if no client caused it."""
    kind: str = ""
    """Finer distinction than `name`, such as the reason of a refusal. A log line about several
    events gives the number of events of each kind."""
    count: int = 1
    """Number of occurrences that this object stands for."""
    news: bool = True
    """False if the event only repeats an earlier event. Its log line may then be delayed."""
    code: Code | Literal[""] = ""
    """Code of the cause; "" if `name` says everything. If the event stands for several events, it
    is the code of the last one."""


class Estimate(Struct, frozen=True, gc=False):
    """The estimate that the odometry computes from one feedback line.

    It is valid at the time `at`.
    """

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
    """Monotonic time at which the daemon wrote the line to which the feedback line is the reply,
    ns. None if the daemon cannot tell which of its lines the board answered."""
    heard_ns: int = 0
    """Monotonic time at which the daemon had received the complete feedback line, ns."""


class Wait(Struct, frozen=True):
    """The condition that must be met before a command source drives the robot.

    `arbiter_text.py` turns it into a sentence.
    """

    what: WaitCode
    """Kind of the condition. `source` explains most kinds. The other kinds are:

    - nothing: The source need not wait.
    - command: The source must send a command.
    - senders: The source need not wait, but some of its senders must wait for another sender.
    """
    source: str = ""
    """The source that the condition `what` is about; "" if `what` is not in this list.

    - neutral: The waiting source, which must send a zero.
    - proof: The waiting source, which must show that its delays are steady.
    - late: The waiting source, whose commands arrive too late.
    - stalled: The waiting source, which has sent no command since the last host stall.
    - zeros: The source that controls the robot, but sends only zeros.
    - higher, equal: The source that controls the robot with a higher or an equal priority.
    """
    seconds: float = 0.0
    """A duration in s, whose meaning depends on `what`.

    - neutral: If several programs may share the identity of a sender, it must send no speed for
      this time after its zero.
    - proof: The delays of the commands must be steady for this time.
    - late: The delay of the commands is longer than this time.
    """
    senders: int = 0
    """Number of senders that wait while the robot follows another sender of the same source."""
    lasts: float = 0.0
    """If `what` is `neutral`: the time, s, for which the source has sent speeds without a zero. If
    `what` is `zeros`: the time, s, for which it has sent only zeros. The time is rounded down to
    one of a few values, so that the text about the condition seldom changes. It is 0 below the
    smallest of these values, and for all other conditions."""
    kept: str = ""
    """Name of a source that sends speeds without effect, because `self.source` controls the robot
    and sends only zeros. It is "another sender of NAME" if the speeds come from another sender of
    the same source NAME. It is "" if there is no such source."""
    ros: bool = False
    """True if the sender that must send a zero uses ROS."""
    shared: bool = False
    """True if several programs may share the identity of the sender that must send a zero."""


class SourceStatus(Struct, frozen=True):
    """The state of a command source.

    `age_s` is the time since the last accepted command of the source, s. It is None after the
    start, a `clear` or another event that requires a zero from each sender, until the next command
    is accepted.
    """

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait


class WheelsStatus(Struct, frozen=True):
    """The result of the checks for wheel faults, slip and slow wheels.

    If the checks find no problem, all fields except `differ` are empty.
    """

    text: str = ""
    """Description of the faults and the slip; "" if there are none."""
    left_out: tuple[str, ...] = ()
    """The names of the wheels that the odometry ignores."""
    slipping: tuple[str, ...] = ()
    """The sides, `left` or `right`, whose wheels have slipped in the last half second."""
    differ: tuple[float, float] = (0.0, 0.0)
    """Learned relative difference between the front and the rear wheel: on the left side, and on
    the right side. 0.01 means that the front wheel rolls 1 % farther than the rear wheel."""
    slow: tuple[str, ...] = ()
    """A text for each wheel that turns slower than commanded. For example, "front_left 60%" means
    that the wheel reaches 60 % of the expected speed."""


class RoutersStatus(Struct, frozen=True):
    """The state of the connections to the endpoints in `bus.connect`.

    `connected` and `missing` are the endpoints with and without a connection.
    """

    connected: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    """Connected endpoints that belong to peers. A peer is not a router, so it does not forward
    messages."""


class GyroSample(Struct, frozen=True, omit_defaults=True):
    """A turn rate about the z axis of base_link, measured by a gyro.

    `rate` is in rad/s and positive to the left. `variance` is the variance of `rate`, rad2/s2, or 0
    if the gyro does not report it. `anew` is True for the first sample after a change to another
    gyro.
    """

    at_ns: int
    """Monotonic time at which the sample arrived, ns."""
    stamp_ns: int | None
    """Time of the measurement by the sender's clock, ns; None if the sample has no stamp."""
    rate: float
    variance: float = 0.0
    anew: bool = False


GyroDoes = Literal[
    "off", "waiting for rest", "waiting for turn", "used", "silent", "disagrees",
    "reversed", "in degrees", "dead", "not believed",
]  # fmt: skip
"""State of the gyro. In the states `used` and `disagrees` (the wheels slip), the odometry takes the
heading from the gyro. In the state `waiting for turn`, the gyro has not agreed with the wheels in a
turn yet, and provides the heading only while the wheels stand still. In all other states, the
heading comes from the wheels."""

TrackUse = Literal["shown", "uncertain", "too far off", "used"]
"""Whether the odometry uses the effective track that it has learned with a gyro: `used`, or the
reason why the odometry does not use it. `shown` means that `odometry.learned_track` is false. The
effective track is the distance between left and right wheels that makes computed turns correct."""


class GyroStatus(Struct, frozen=True):
    """The state of the gyro and the values that were learned with it.

    A value that is not known yet is None.
    """

    does: GyroDoes = "off"
    bias: float | None = None
    """Turn rate that the gyro reports at rest, rad/s."""
    delay: float = 0.0
    """Time by which the gyro reports a turn later than the wheels, s. It is negative if the gyro
    reports the turn earlier."""
    track: float | None = None
    """Learned effective track divided by the configured effective track."""
    track_deviation: float = 0.0
    """Standard deviation of `track`, divided by `track`."""
    track_use: TrackUse = "shown"


EstopState = Literal["", "released", "pressed", "silent"]
"""State of the emergency-stop input; "" if the board has never reported this input. `silent` means
that the board has stopped reporting the input, which counts as pressed."""


BatteryLevel = Literal["ok", "warning", "return", "stop", "unknown"]
"""Level of the battery by the thresholds in `[battery]`, for the voltage or the charge; `ok` if no
threshold is set. `unknown` means that the board does not report this quantity, or has reported it
only for a few seconds so far."""


class BatteryStatus(Struct, frozen=True, gc=False):
    """The battery as the board reports it. A value that the board does not report now is None."""

    level: BatteryLevel
    reported_ns: int | None = None
    """Monotonic time of the board's last report about the battery, ns. None while the board does
    not report the battery."""
    volts: float | None = None
    percent: float | None = None
    """State of charge, 0 to 100."""
    amps: float | None = None
    """Current, A. It is negative while the battery discharges."""
    mean: float | None = None
    """The value that is compared with the thresholds: the voltage (V) or the charge (%), averaged
    over about 10 s."""


class Latch(Struct, frozen=True):
    """A stop, a fault or a deactivation of the robot, which lasts until a person releases it."""

    number: int
    """Number that identifies the latch, even after a restart: the time at which the latch was set,
    ms since 1970. If this time is not later than the number of an earlier latch, a larger number is
    used, so that numbers always grow. JavaScript represents the number exactly."""
    at_ns: int
    """Wall-clock time at which the latch was set, ns since 1970."""
    by: str
    """Name of the client that requested the latch; "" if no client requested it, as for a
    fault."""
    why: str
    """Reason in words, such as "stopped by NAME" or the cause of a fault."""
    code: Code
    part: str = ""
    """The part of the robot that the cause is about, such as a wheel; "" if the code says it."""
    kept: bool = False
    """True if the latch was set before the present run of the daemon."""
    earlier: tuple[Latch, ...] = ()
    """The earlier causes of the same stop or fault, each as a latch, the newest first. When a new
    cause replaces a latch, the old latch moves to this tuple. The field `earlier` of the latches in
    this tuple is empty."""

    @property
    def causes(self) -> tuple[Latch, ...]:
        """All causes of the same stop or fault, each as a latch: this latch, then `earlier`."""
        return (self, *self.earlier)

    @property
    def cause(self) -> tuple[str, str, str]:
        """The identity of the cause. Two latches with the same identity have the same cause."""
        return self.code, self.part, self.by

    def each(self, change: Callable[[Latch], Latch]) -> Latch:
        """Return a copy with `change` applied to this latch and to each latch in `earlier`."""
        return replace(change(self), earlier=tuple([change(cause) for cause in self.earlier]))


class Latches(Struct, frozen=True):
    """The latches. The daemon stores them in a file, so that they last even if it is killed."""

    stop: Latch | None = None
    fault: Latch | None = None
    inactive: Latch | None = None

    @property
    def next(self) -> Latch | None:
        """The latch that `clear` releases next: the fault, else the stop, else None."""
        return self.fault or self.stop

    @property
    def in_force(self) -> Latch | None:
        """The latch that decides the mode: the fault, else the stop, else `inactive`, else None."""
        return self.next or self.inactive

    def after_restart(self) -> Latches:
        """Return the latches for the next run of the daemon, each with `kept = True`."""
        stop, fault, inactive = (
            None if latch is None else latch.each(lambda cause: replace(cause, kept=True))
            for latch in (self.stop, self.fault, self.inactive)
        )
        return Latches(stop, fault, inactive)


class SpeedCap(Struct, frozen=True):
    """A speed limit from the key `speed_limit`, which holds beside `limits.linear_speed`."""

    speed: float | None
    """Highest linear speed, m/s. None lifts the limit."""
    by: str = ""
    """Name of the sender, for the log."""


class Inputs(Struct, frozen=True):
    """The complete input of one control step.

    - tick: True if the step must compute the line of a control period.
    - at_once: True if the step may compute an extra line for a new command or mode.
    - opened: Number of times that the serial port was opened so far. If the number has grown, the
      step begins a new session with the board.
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
    guard_trip: GuardCode | Literal[""] = ""
    """Why the guard replaced the previous line with zeros; "" if it did not. If the guard replaced
    a line, the robot latches a fault."""
    superseded: bool = False
    """True if the line of the previous step was not written to the port."""
    missed: int = 0
    """Number of control periods without a step since the previous step."""
    events: tuple[Event, ...] = ()
    """Events of other parts of the daemon, to be logged together with the robot's events."""
    at_once: bool = False
    shutting_down: bool = False
    """True if the daemon is shutting down. The robot then ramps to zero and stays there."""
    late_ns: int = 0
    """Time from the start of the previous step until its line was written, ns. It is 0 if this
    time is below 1 ms, or if no line was written. A longer time means that the process has stalled
    in between."""
    speed_cap: SpeedCap | None = None
    """The newest speed limit that arrived since the previous step; None if none arrived."""


class Outputs(Struct, frozen=True):
    """All decisions of one control step."""

    now: Instant
    due: bool
    """True if this step had to compute a line for the board: the line of a control period, or an
    extra line for a new command or mode."""
    line: bytes | None
    """The line for the board; None if no line was due."""
    speeds: WheelSpeeds
    """Wheel speeds of the last computed line, which is `line` if a line was due. They are 0 if the
    robot has cut its speed to zero since then, for example because the link was lost."""
    applied: Twist
    """Twist of the last computed line, after all limits. It is zero if the robot has cut its speed
    to zero since then, for example because the link was lost."""
    linked: bool
    """True if the link to the board is up. Otherwise the guard replaces each line that moves a
    wheel by the stop line."""
    estimates: tuple[Estimate, ...]
    mode: str
    code: Code
    """Why the robot moves or does not move."""
    reason: str
    """The same in words."""
    link: str
    source: str
    """Source that the arbiter has selected; "" if no source is selected. A selected source does
    not always drive: it may still have to send a zero, or a latch may keep the robot from
    driving."""
    command_ns: int | None
    """Monotonic time at which the selected command arrived, ns; None if no command is selected."""
    status_changed: bool
    """True if `mode`, `code`, `reason`, `link`, `source` or the level of the battery has changed in
    this step."""
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    news: bool = False
    """True if the board should get a new line without delay: the command or the mode has changed
    since the previously computed line, or the emergency stop or a bumper was pressed. If this step
    has already computed the new line, `due` is true too."""
    latches: Latches = Latches()
    """The latches after the step. A latch has changed if this is not the same object as in the
    previous step."""


class Spread(Struct, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, in the measurements' unit."""

    count: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Measured(Struct, frozen=True):
    """Statistics of one latency of the daemon, us, such as the time from a command to its line."""

    since_start: Spread = Spread()
    last_minute: Spread = Spread()


class Recording(Struct, frozen=True):
    """The state of the recorder, which writes every control step to files."""

    where: str = ""
    """Directory of the recordings; "" if recording is switched off."""
    trouble: str = ""
    """Why recording fails at present, in words; "" if recording works or is switched off."""
    missing: int = 0
    """Number of steps that were not recorded."""


class Snapshot(Struct, frozen=True):
    """The values for the messages `state` and `diagnostics` that are not in `Outputs`."""

    pose: Pose
    measured: Twist | None  # None while the feedback is silent
    speeds: WheelSpeeds | None  # None while the feedback is silent
    sources: tuple[SourceStatus, ...]
    counters: dict[str, int]
    refused: str
    """The last command that was refused, and the reason; "" if no command was refused yet."""
    refused_age_s: float | None = None
    """Time since a command was last refused, s; None if no command was refused yet. A command that
    is refused only because its sender is new does not count."""
    feedback_age_s: float | None = None
    """Time since the last valid feedback line of the board, s; None before the first line."""
    missed_last_minute: int = 0
    """Number of control periods in the last minute in which no control step ran."""
    figures: dict[str, Measured] = {}
    """The latencies of the daemon, by the names in `daemon/latencies.py`."""
    gyro: GyroStatus = GyroStatus()
    doubt: WheelsStatus = WheelsStatus()
    estop: EstopState = ""
    bumpers: tuple[bool, ...] | None = None
    """Whether each bumper counts as pressed, in the order of the board's reports. None if the
    board has never reported its bumpers."""
    bumper: Reason | None = None
    """Why a bumper counts as pressed; None while no bumper counts as pressed."""
    battery: BatteryStatus | None = None
    """State of the battery; None if the board has never reported the battery."""
    board: dict[str, str] = {}
    """The last value of each field of the board's status lines, as text by field name. The entry
    `age_s` is the age of the last status line, s. The map is empty before the first status
    line."""
    check: str = "plain"
    """Whether the serial lines have a checksum, in words, such as "plain" or "checked"."""
    encoders: tuple[int, ...] = ()
    """Configured encoder counts per wheel turn, in `WHEELS` order. All are 0 if no counts are
    configured, or if the reported speeds contradict the configured counts: each speed should be an
    integer number of counts divided by a time."""
    sender: str = ""
    """Sender that the arbiter has selected; "" if no sender is selected."""
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    latch_file: str | None = None
    """Why the latches would be lost if the daemon restarted now, in words. It is "" if they would
    be kept, and None if this daemon has no latch file."""
    settings_differ: str = ""
    """The settings that `set` changed since the daemon's start, in words. The text is "" if there
    are none, and in an export of a recording."""
    speed_limit: str = ""
    """The speed limit that lowers a setting, in words. The text is "" if no speed limit does, and
    in an export of a recording."""
