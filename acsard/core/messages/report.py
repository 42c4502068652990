"""Builds the messages that are due after a control step, and the present message of a key.

Only those with a subscriber or a query are built. All of a feedback line have its stamp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from functools import partial

from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.config.settings import DIAGNOSTICS_HZ, STATE_HZ, Config
from acsard.core.messages.certificate_expiry import DAY_NS, expiry, first_expiry, short_code
from acsard.core.messages.diagnostics import diagnostics
from acsard.core.messages.frames import (
    FeedbackTopic,
    odom_numbers,
    tf_numbers,
    wheel_states_numbers,
)
from acsard.core.messages.keys_and_roles import BEAT, BEAT_HZ
from acsard.core.messages.recent_events import RecentEvents
from acsard.core.messages.schema import (
    Battery,
    DiagnosticArray,
    Header,
    JointState,
    Message,
    Odometry,
    Pose,
    PoseWithCovariance,
    Quaternion,
    RobotState,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.messages.snapshot import Snapshot
from acsard.core.values import (
    NS_PER_S,
    REST,
    Estimate,
    Instant,
    News,
    Ns,
    PoseCovariance,
    Rad,
    TwistVariances,
)
from acsard.core.values import Twist as BodyTwist

GetSnapshot = Callable[[], Snapshot]

# Returns None if there is no message now.
BuildSummary = Callable[[Instant, Snapshot], Message | None]

UNKNOWN_STATUS, CHARGING, DISCHARGING, NOT_CHARGING = range(4)  # `Battery.power_supply_status`


BATTERY_HZ = 1.0

# Variance of an axis that wheels do not measure (m2, rad2, m2/s2 or rad2/s2). It is the largest
# that RViz can draw and a filter can invert.
UNMEASURED = 1e6

UNKNOWN_COVARIANCE = [UNMEASURED if cell % 7 == 0 else 0.0 for cell in range(36)]


NEVER_NS = -(1 << 62)

# Topics whose messages are not of a feedback line, nor latched.
_OTHERS = frozenset({"cmd_vel_out", "events", "state", "diagnostics", "battery"})


class _Rate:
    # The rate of the messages of one key. A change of the rate must not make one due, so the last
    # one counts.
    def __init__(self) -> None:
        self._last_ns, self._period_ns, self._pause_ns = NEVER_NS, 0, 0
        self.due_ns = NEVER_NS  # of the next message

    def use(self, hz: float) -> None:
        # 0 Hz is no limit.
        self._period_ns = period_ns = int(NS_PER_S / hz) if hz else 0
        # Allow a twentieth of the period as grace. Otherwise a step that is a microsecond early
        # would wait for the next period.
        self._pause_ns = period_ns - period_ns // 20
        self.due_ns = self._last_ns + self._pause_ns

    def record(self, now_ns: Ns, at_once: bool = False) -> None:
        # Of a message now; `at_once`: before it was due.
        next_ns = self._last_ns + self._period_ns
        behind = at_once or now_ns - next_ns > self._period_ns
        last_ns = self._last_ns = now_ns if behind else next_ns
        self.due_ns = last_ns + self._pause_ns


class Report:
    """Builds the messages that the daemon publishes, and knows when each is due."""

    def __init__(
        self,
        config: Config,
        start: Instant,
        certificate_ends: Mapping[str, int] | None = None,
        version: str = "",
    ) -> None:
        # Expiry by owner, "" for the robot's own (maybe by the TLS gateway's report), ns since
        # 1970.
        self.certificate_ends = dict(certificate_ends or {})
        self._names = list(config.joint_names)
        self._start, self._version = start, version
        angles_and_speeds = partial(wheel_states_numbers, len(self._names))
        self._estimate: Estimate | None = None
        self._now: Instant | None = None  # of the last wake-up
        self._happened = RecentEvents()
        self._feedback = (
            FeedbackTopic("odom", self._odom, odom_numbers),
            FeedbackTopic("tf", self._tf, tf_numbers),
            FeedbackTopic("wheel_states", self._wheel_states, angles_and_speeds),
        )
        # Builders by key; also due with `status_changed`.
        self._summaries: dict[str, BuildSummary] = {
            "state": self._state,
            "diagnostics": self._diagnostics,
            "battery": self._battery,
        }
        limited = (BEAT, "odom", "wheel_states", "cmd_vel_out", *self._summaries)
        self._rates = {key: _Rate() for key in limited}
        self.config = config

    @property
    def config(self) -> Config:
        """The configuration in force."""
        return self._config

    @config.setter
    def config(self, config: Config) -> None:
        self._config, limits = config, config.rates
        highest = {
            BEAT: BEAT_HZ,
            "odom": limits.odom,
            "wheel_states": limits.telemetry,
            "cmd_vel_out": limits.telemetry,
            "state": limits.at_most(STATE_HZ),
            "diagnostics": limits.at_most(DIAGNOSTICS_HZ),
            "battery": limits.at_most(BATTERY_HZ),
        }
        for key, rate in self._rates.items():
            rate.use(highest[key])

    def due(
        self,
        now: Instant,
        news: News,
        applied: BodyTwist | None,
        wanted: Collection[str],
        get_snapshot: GetSnapshot,
    ) -> list[tuple[str, Message]]:
        """Return the keys and messages to publish after this wake-up."""
        feedback: list[tuple[str, Message]] = [
            (topic.key, topic.build(estimate))
            for estimate in news.estimates
            for topic in self.feedback_due(estimate, wanted)
        ]
        if applied is None and not (news.events or news.status_changed):
            return feedback
        return feedback + self.others_due(now, news, applied, wanted, get_snapshot)

    def beat_due(self, now_ns: Ns, wanted: Collection[str]) -> bool:
        """Return whether a beat is to be published."""
        beat = self._rates[BEAT]
        if now_ns < beat.due_ns or BEAT not in wanted:
            return False
        beat.record(now_ns)
        return True

    def feedback_due(self, estimate: Estimate, wanted: Collection[str]) -> list[FeedbackTopic]:
        """Return the topics on which a message of this feedback line is to be published."""
        self._estimate = estimate
        due: list[FeedbackTopic] = []
        rates, at_ns = self._rates, estimate.at.mono_ns
        odom, tf, wheel_states = self._feedback
        rate = rates["odom"]
        if at_ns >= rate.due_ns and ("odom" in wanted or "tf" in wanted):
            rate.record(at_ns)
            if "odom" in wanted:
                due.append(odom)
            if "tf" in wanted and self._config.odometry.publish_tf:
                due.append(tf)
        rate = rates["wheel_states"]
        if at_ns >= rate.due_ns and "wheel_states" in wanted:
            rate.record(at_ns)
            due.append(wheel_states)
        return due

    def others_due(
        self,
        now: Instant,
        news: News,
        applied: BodyTwist | None,
        wanted: Collection[str],
        get_snapshot: GetSnapshot,
    ) -> list[tuple[str, Message]]:
        """Return the messages that are not of a feedback line.

        `applied` is the twist in a line that was due in this wake-up. Bytes alone make no message
        due: a summary waits for the next line, unless something has happened.
        """
        self._now = now
        if news.events:
            self._happened.add(news.events, now)
        due: list[tuple[str, Message]] = []
        if _OTHERS.isdisjoint(wanted):
            return due
        now_ns, rates, changed = now.mono_ns, self._rates, news.status_changed
        rate = rates["cmd_vel_out"]
        if applied is not None and now_ns >= rate.due_ns and "cmd_vel_out" in wanted:
            rate.record(now_ns)
            due.append(("cmd_vel_out", self._cmd_vel_out(now, applied)))
        if news.events and "events" in wanted and (events_message := self._happened.message()):
            due.append(("events", events_message))
        for key, build in self._summaries.items():
            rate = rates[key]
            if (changed or now_ns >= rate.due_ns) and key in wanted:
                rate.record(now_ns, changed)
                message = build(now, get_snapshot())
                if message is not None:
                    due.append((key, message))
        return due

    def current(self, key: str, get_snapshot: GetSnapshot) -> Message | None:
        """Return the present message of a published key, or None if there is none."""
        estimate, now = self._estimate, self._now
        match key:
            case "tf_static":
                return self.tf_static()
            case "odom":
                return self._odom(estimate, bool(get_snapshot().state.wheels)) if estimate else None
            case "tf":
                return self._tf(estimate) if estimate and self._config.odometry.publish_tf else None
            case "wheel_states":
                return (
                    self._wheel_states(estimate, bool(get_snapshot().state.wheels))
                    if estimate
                    else None
                )
            case "cmd_vel_out":
                return self._cmd_vel_out(now, get_snapshot().applied) if now else None
            case "events":
                return self._happened.message()
            case _:
                summary = self._summaries.get(key)
                return summary(now, get_snapshot()) if summary and now else None

    def tf_static(self) -> TFMessage:
        """Return the transform of the lidar, empty if it is switched off."""
        lidar = self._config.lidar
        if not lidar.publish_tf:
            return TFMessage([])
        base = Header(Time.from_ns(self._start.wall_ns), self._config.odometry.base_frame)
        place = Vector3(lidar.lidar_x_offset, lidar.lidar_y_offset)
        pose = Transform(place, from_yaw(lidar.lidar_yaw))
        return TFMessage([TransformStamped(base, lidar.lidar_frame, pose)])

    def _odom(self, estimate: Estimate, live: bool = True) -> Odometry:
        # Not `live`: without feedback, the twist is 0 and of `UNKNOWN_COVARIANCE`.
        frames, pose = self._config.odometry, estimate.pose
        of_pose = pose_covariance(estimate.covariance)
        of_twist = twist_covariance(estimate.twist_variances) if live else UNKNOWN_COVARIANCE
        return Odometry(
            Header(Time.from_ns(estimate.at.wall_ns), frames.odom_frame),
            frames.base_frame,
            PoseWithCovariance(Pose(Vector3(pose.x, pose.y), from_yaw(pose.yaw)), of_pose),
            TwistWithCovariance(_twist(estimate.twist if live else REST), of_twist),
        )

    def _tf(self, estimate: Estimate) -> TFMessage:
        frames, pose = self._config.odometry, estimate.pose
        header = Header(Time.from_ns(estimate.at.wall_ns), frames.odom_frame)
        where = Transform(Vector3(pose.x, pose.y), from_yaw(pose.yaw))
        return TFMessage([TransformStamped(header, frames.base_frame, where)])

    def _wheel_states(self, estimate: Estimate, live: bool = True) -> JointState:
        return JointState(
            header=Header(Time.from_ns(estimate.at.wall_ns)),
            name=self._names,
            position=list(estimate.positions[: len(self._names)]),
            velocity=list(estimate.speeds.as_tuple()[: len(self._names)]) if live else [],
        )

    def _cmd_vel_out(self, now: Instant, applied: BodyTwist) -> TwistStamped:
        header = Header(Time.from_ns(now.wall_ns), self._config.odometry.base_frame)
        return TwistStamped(header, _twist(applied))

    def _state(self, now: Instant, snapshot: Snapshot) -> RobotState:
        certificate = self._certificate(now)
        return replace(
            snapshot.state,
            stamp=Time.from_ns(now.wall_ns),
            certificate=short_code(certificate) if certificate else "",
            certificate_expiry=certificate.text if certificate else "",
            certificate_days=self._certificate_days(now),
            version=self._version,
        )

    def _certificate_days(self, now: Instant) -> float | None:
        if not (self._config.bus.tls and self.certificate_ends):
            return None
        return round((first_expiry(self.certificate_ends)[1] - now.wall_ns) / DAY_NS, 2)

    def _battery(self, now: Instant, snapshot: Snapshot) -> Battery | None:
        # Stamped with the last report, or now if the reports have stopped.
        battery = snapshot.battery
        if battery is None:
            return None
        age_ns = 0 if battery.reported_ns is None else now.mono_ns - battery.reported_ns
        amps, percent = battery.amps, battery.percent
        status = UNKNOWN_STATUS
        if amps is not None:
            status = CHARGING if amps > 0 else DISCHARGING if amps < 0 else NOT_CHARGING
        return Battery(
            Header(Time.from_ns(now.wall_ns - age_ns)),
            voltage=battery.volts,
            current=amps,
            percentage=None if percent is None else percent / 100,
            power_supply_status=status,
            present=battery.reported_ns is not None,
        )

    def _certificate(self, now: Instant) -> Reason | None:
        bus = self._config.bus
        if not bus.tls or not (self.certificate_ends or bus.uses_tls):
            return None
        return expiry(self.certificate_ends, now.wall_ns)

    def _diagnostics(self, now: Instant, snapshot: Snapshot) -> DiagnosticArray:
        return diagnostics(self._config, now, snapshot, self._certificate(now))


def _twist(twist: BodyTwist) -> Twist:
    return Twist(Vector3(x=twist.linear), Vector3(z=twist.angular))


def pose_covariance(p: PoseCovariance) -> list[float]:
    """Return the 6x6 covariance of the pose in the frame odom, m2, m rad and rad2.

    Its axes are x, y, z, roll, pitch and yaw, and the rotations are about axes through the robot
    that are parallel to those of odom.
    """
    u = UNMEASURED
    # fmt: off
    return [
        p.xx,    p.xy,   0.0,  0.0,  0.0,  p.xyaw,
        p.xy,    p.yy,   0.0,  0.0,  0.0,  p.yyaw,
        0.0,     0.0,    u,    0.0,  0.0,  0.0,
        0.0,     0.0,    0.0,  u,    0.0,  0.0,
        0.0,     0.0,    0.0,  0.0,  u,    0.0,
        p.xyaw,  p.yyaw, 0.0,  0.0,  0.0,  p.yawyaw,
    ]
    # fmt: on


def twist_covariance(v: TwistVariances) -> list[float]:
    """Return the 6x6 covariance of the twist in the frame base_link, m2/s2 and rad2/s2."""
    cells = [0.0] * 36
    cells[::7] = (v.linear, v.lateral, UNMEASURED, UNMEASURED, UNMEASURED, v.angular)
    return cells


def from_yaw(yaw: Rad) -> Quaternion:
    """Return the rotation by `yaw` about z."""
    return Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
