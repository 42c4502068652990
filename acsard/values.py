"""The nouns of acsard, in SI units; every other module speaks in these.

What lives here: frozen values without behaviour beyond simple arithmetic on themselves (`gc=False`:
they are in no cycle). What must not: clocks, I/O, decisions. Wheel order is `WHEELS` everywhere.
"""

from __future__ import annotations

from typing import Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
"""The order of every four-wheel value, index 0 to 3."""

NS_PER_S = 1_000_000_000

ROOT = "acsard"
"""Begins every key of the native tree: `acsard/<robot.id>/...`."""

Role = Literal["viewer", "operator", "maintainer"]
"""What somebody may do on the bus; each may what those before it may."""

ROLES: tuple[Role, ...] = get_args(Role)


class AcsardError(Exception):
    """Base of the errors acsard raises on purpose; anything else that is raised is a bug."""


class Instant(Struct, frozen=True, gc=False):
    """One reading of both clocks: ages and periods use `mono_ns`, published stamps `wall_ns`."""

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
        """The four speeds in `WHEELS` order."""
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
    """Variances of one report in base_link: along x and y in m2/s2, of the turning in rad2/s2."""

    linear: float
    lateral: float
    angular: float


class Received(Struct, frozen=True):
    """Bytes as one read of the serial port gave them, and when."""

    at: Instant
    data: bytes


class Command(Struct, frozen=True):
    """A velocity wish of one commander. Three words tell whose it is, here and everywhere:

        source  what it commands as, one of `commands.sources`: the `app` of `cmd/app`
        sender  its public name, as far as the envelope says: two programs on one source are two
        clock   what stamped it: the sender's own attachment, Zenoh for it, or a message's header

    `arrived_ns` is the monotonic time of arrival and alone decides the age; `stamp_ns` is when it
    was sent by that clock, which nobody has set by ours.
    """

    source: str
    twist: Twist
    arrived_ns: int
    stamp_ns: int | None = None
    clock: str = ""
    sender: str = ""
    cancelled: bool = False
    """The twist is zero only because what was asked for cancels out: nobody let go."""
    sequence: int | None = None
    """Its number among those of its sender: none is missing unless it was sent and lost."""
    shared: bool = False
    """Several programs may look like this sender: it came by a bridge, or has only its key."""
    ros: bool = False
    """It came from ROS, whose tools send no zero by themselves."""
    stamp_replaced: bool = False
    """Zenoh took its timestamp away: the sender's clock is ahead of ours."""
    steady: bool = False
    """The stamp comes from a clock that is never adjusted, as the sender's attachment says."""


Verb = Literal["stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set"]

Plain = bool | int | float | str | list[float | str]
"""The value of a setting, as who asks for it writes it."""


class Request(Struct, frozen=True):
    """A service call or a stop; `id` finds the caller again, 0 when nobody waits for an answer."""

    verb: Verb
    id: int = 0
    pose: Pose | None = None
    asked_ns: int | None = None
    """When it arrived, monotonic: a clear must not undo a stop that came after it."""
    by: str = ""
    """Who asked, as `incoming/asker.py` puts it."""
    settings: dict[str, Plain] = {}
    """What `set` is to set, by key as in `config/live.py`."""
    latch: int | None = None
    """Number of the latch that `clear` or `activate` releases; None if the client names none."""


class Answer(Struct, frozen=True):
    """What became of the `Request` with the same `id`."""

    id: int
    success: bool
    message: str


class Refusal(Struct, frozen=True):
    """A command that does not count: `reason` is what it is counted under, `text` is for people."""

    reason: str
    text: str
    source: str = ""
    sender: str = ""
    arrived_ns: int = 0
    """Whose command it would have been, as far as that is known."""


EventName = Literal[
    "started", "ended", "signal", "configuration", "real_time", "connecting",
    "port_open", "port_waiting", "port_lost",
    "link_down", "link_booting", "link_up", "link_stale", "link_check", "mcu_restarted",
    "lines_rejected", "lines_dropped", "lines_lost", "wheels_turned", "wheels_doubted",
    "gyro", "track", "imu_refused",
    "bus_stuck", "router_missing", "router_found", "no_router",
    "missed_periods", "recording", "latch_file",
    "door_open", "door_crowded", "door_stuck", "door_alone", "door_ended",
    "page_ended", "page_refused",
    "router_open", "router_crowded", "router_stuck", "router_ended",
    "stop", "clear", "activate", "deactivate", "reset_odometry", "set_pose", "set",
    "mode", "commander", "kept_waiting", "first_contact", "command_refused", "fault",
]  # fmt: skip
"""All that the log can be asked for; `deploy/systemd/README.md` says what each means."""

Level = Literal["info", "warning", "error"]


class Event(Struct, frozen=True):
    """Something worth a log line; `text` is for people. `tally.py` keeps it to a line a second."""

    name: EventName
    text: str
    level: Level = "info"
    by: str = ""
    """Who asked, sent or commands, "" when that is nobody."""
    kind: str = ""
    """What is counted apart when it repeats itself: a reason, a change."""
    count: int = 1
    """How many times, since the last line of this name."""
    news: bool = True
    """False for more of the same: that may wait for its second."""


class Estimate(Struct, frozen=True, gc=False):
    """One feedback line folded into odometry; all its parts share the stamp `at`."""

    at: Instant
    pose: Pose
    twist: Twist
    covariance: PoseCovariance
    twist_variances: TwistVariances
    positions: tuple[float, float, float, float]
    """Wheel angles in rad since start, continuous, in `WHEELS` order."""
    speeds: WheelSpeeds
    asked_ns: int | None = None
    """When the line it answers was made, monotonic; None where a reply does not tell which."""
    heard_ns: int = 0
    """When the line was complete here, monotonic."""


class Wait(Struct, frozen=True):
    """What a source waits for, and what `drive/words.py` needs to say it."""

    what: Literal[
        "nothing", "command", "proof", "late", "neutral", "zeros", "higher", "equal", "senders"
    ]
    source: str = ""
    """Who must be neutral or prove its clock; who sends nothing but zeros; of higher or equal
    priority, who has the robot."""
    seconds: float = 0.0
    """s without a speed behind the zero of a shared identity, or s that a proof takes."""
    senders: int = 0
    """How many wait while another sender of the same source is followed."""
    lasts: float = 0.0
    """s that it has lasted at the least, one of a few: it must not change each step."""
    kept: str = ""
    """The source that sends speeds meanwhile and is kept waiting."""
    ros: bool = False
    """The sender that must send a zero sends from ROS."""
    shared: bool = False
    """Several programs may share the identity of the sender that must send a zero."""


class SourceStatus(Struct, frozen=True):
    """What one source is doing: `age_s` since its last accepted command, None if never heard."""

    name: str
    priority: int
    age_s: float | None
    waits_for: Wait


class WheelsStatus(Struct, frozen=True):
    """What front and rear of each side say of each other; all empty while they agree."""

    text: str = ""
    """What is wrong, in words."""
    left_out: tuple[str, ...] = ()
    """The wheels that the pose goes without."""
    slipping: tuple[str, ...] = ()
    """`left`, `right`: now, or half a second ago."""
    differ: tuple[float, float] = (0.0, 0.0)
    """By which share the front wheel turns more than the rear one, left and right, always."""


class RoutersStatus(Struct, frozen=True):
    """What `bus.connect` names; both are empty where that is."""

    connected: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    """Those of the connected that are no routers, and hand on nothing."""


class GyroSample(Struct, frozen=True, omit_defaults=True):
    """What a gyro said: `rate` rad/s about base_link's z, left is +, and its `variance`, rad2/s2.

    A variance of 0 is one that the gyro does not tell. `anew`: the first of another gyro.
    """

    at_ns: int
    """When it arrived, monotonic."""
    stamp_ns: int | None
    """When it was measured by the sender's clock; None where that is not told."""
    rate: float
    variance: float = 0.0
    anew: bool = False


GyroDoes = Literal[
    "off", "waiting for rest", "used", "silent", "disagrees",
    "reversed", "in degrees", "dead", "not believed",
]  # fmt: skip
"""Of these `used` and `disagrees` (the wheels slip) take the heading from it."""

TrackUse = Literal["shown", "uncertain", "too far off", "used"]
"""Of the effective track that a gyro implies; the configured one is in use unless it is `used`."""


class GyroStatus(Struct, frozen=True):
    """What the gyro does for odometry, and what is known of it; None is not known yet."""

    does: GyroDoes = "off"
    bias: float | None = None
    """rad/s"""
    delay: float = 0.0
    """s by which it tells later than the wheels."""
    track: float | None = None
    track_deviation: float = 0.0
    """The effective track it implies, as a share of the configured one; its deviation of that."""
    track_use: TrackUse = "shown"


class Latch(Struct, frozen=True):
    """One latch: a stop, a fault or the robot being switched off."""

    number: int
    """Identifies the latch: milliseconds since 1970, or one more than the latch before.

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
    """Everything one step may know.

    `tick` says that the clock's line goes out with this step, `at_once` that one may if there is
    something new to say; without either only feedback is folded.
    `opened` counts how often the port has been opened: a new number is a new session with the MCU.
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
    """The bus messages refused before they became a `Command`."""
    guard_trip: str = ""
    """Why the guard replaced the previous line with STOP; latches a fault."""
    superseded: bool = False
    """The line of the step before did not go out: what it said never happened."""
    missed: int = 0
    """Periods that ended without a step, since the step before."""
    events: tuple[Event, ...] = ()
    """What the shell has to say, to be kept to a line a second with the rest."""
    at_once: bool = False
    leaving: bool = False
    """The daemon is going down: ramp to zero and stay there."""


class Outputs(Struct, frozen=True):
    """Everything one step decided."""

    now: Instant
    due: bool
    """A line was, by the clock or at once."""
    line: bytes | None
    """The line for the MCU, or None when none is due."""
    speeds: WheelSpeeds
    applied: Twist
    linked: bool
    estimates: tuple[Estimate, ...]
    mode: str
    reason: str
    """Why it moves or does not, in words."""
    link: str
    source: str
    """Whose command counts, "" when nobody's does."""
    command_ns: int | None
    """When the command that is followed arrived, monotonic; None when none is."""
    status_changed: bool
    """One of the four above differs from the step before."""
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    news: bool = False
    """Another command is followed, or none any more, or the mode is another one, than when the last
    line was due."""
    latches: Latches = Latches()
    """The latches in force after the step; the same object until one of them changes."""


class Spread(Struct, frozen=True):
    """Median, 99th percentile and maximum of `count` measurements, in one unit."""

    count: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Measured(Struct, frozen=True):
    """One of the daemon's figures of itself, us."""

    since_start: Spread = Spread()
    last_minute: Spread = Spread()


class Recording(Struct, frozen=True):
    """How the black box does."""

    where: str = ""
    """The directory, "" when nothing is recorded."""
    trouble: str = ""
    """Why it is not recorded just now, in words."""
    missing: int = 0
    """Steps that were not recorded."""


class Snapshot(Struct, frozen=True):
    """What `state` and `diagnostics` show beyond one step's outputs."""

    pose: Pose
    measured: Twist | None  # None while the feedback is silent
    speeds: WheelSpeeds | None  # None while the feedback is silent
    sources: tuple[SourceStatus, ...]
    counters: dict[str, int]
    refused: str
    """The last command that was refused and why, "" when none was."""
    refused_age_s: float | None = None
    """s since one was refused for more than that its sender is new here, None when none was."""
    feedback_age_s: float | None = None  # since the last good line, None before the first one
    missed_last_minute: int = 0
    """Periods without a step."""
    figures: dict[str, Measured] = {}
    """What the daemon measures of itself, by the names in `runtime/figures.py`."""
    gyro: GyroStatus = GyroStatus()
    doubt: WheelsStatus = WheelsStatus()
    check: str = "plain"
    """Which check the serial lines have, in words."""
    encoders: tuple[int, ...] = ()
    """Counts per turn that the lines show, in `WHEELS` order; 0 where they show none."""
    sender: str = ""
    """Whose command counts, of the senders of one source; "" when nobody's does."""
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    latch_file: str | None = None
    """Why the latches would not survive a restart, in words; None where nothing is kept."""
