"""Integrates wheel speeds into pose, twist and covariance of base_link in odom.

    (4)  d_left = r_l left dt            (5)  d_right = r_r right dt
    (6)  d = (d_right + d_left) / 2      (7)  dyaw = (d_right - d_left) / L
    (8)  x += d cos(yaw)                 (9)  y += d sin(yaw)
    (10) yaw += dyaw, wrapped            (11) v = d / dt, w = dyaw / dt

`left` and `right` are of `kinematics.py`, equation 1. Instead of (8) and (9), the pose moves on the
exact arc, whose limit they are for dyaw -> 0.
"""

from __future__ import annotations

import math

from msgspec import Struct, field

from acsard.core.link.feedback import MAX_FILLED_GAP_S, Line
from acsard.core.motion.consistency import ConsistencyChecks
from acsard.core.motion.doubts import Doubts, Step
from acsard.core.motion.gaps import AT_REST, LONG_S, Rolled, Skipped, plus, rolled_over, times
from acsard.core.motion.gyro import REST_S
from acsard.core.motion.kinematics import on_arc
from acsard.core.motion.uncertainty import (
    UPDATE_S,
    ErrorModel,
    Missed,
    Path,
    Uncertainty,
    pushed,
)
from acsard.core.motion.wheels import Wheels
from acsard.core.values import (
    NS_PER_S,
    REST,
    STILL,
    Estimate,
    Metres,
    Ns,
    Pose,
    Rad,
    Seconds,
    Twist,
    Wheels4,
    WheelSpeeds,
)

# Columns of the doubts: the lines, and what a silence hid.
USUAL: tuple[Missed, Missed] = ("way", "turn")
SILENT: tuple[Missed, Missed] = ("silent way", "silent turn")


class Odometry(Struct):
    """Pose, covariance and angles of the wheels. What is derived from settings is in `model`."""

    uncertainty: Uncertainty
    pose: Pose = Pose()  # of base_link in odom, yaw within [-pi, pi]
    path: Path = Path()  # of base_link
    twist: Twist = REST  # in the last line
    speeds: WheelSpeeds = STILL  # in the last line
    earlier: WheelSpeeds = STILL  # in the line before it
    positions: Wheels4 = AT_REST  # of the wheels, rad
    travelled: Metres = 0.0  # since the daemon started, forwards plus backwards
    skipped: Skipped = field(default_factory=Skipped)
    doubts: Doubts = field(default_factory=Doubts)
    held: Wheels4 = AT_REST  # rad at rest; for the pose beyond two counts, or in a drive
    rested: Seconds = math.inf  # of zero speeds, without gaps
    # The pose was set then, after the last line: a part of the motion since that line came before.
    set_ns: Ns = 0
    late: Twist = REST  # m and rad by `Line.late`, since the last update
    state: tuple[bool, bool, bool] = (True, False, False)  # at rest, slips, by a gyro
    gaps: int = 0  # with unknown motion
    unknown: Seconds = 0.0  # in these
    filled: Seconds = 0.0

    @classmethod
    def initial(cls, model: ErrorModel) -> Odometry:
        return cls(Uncertainty.initial(model, Pose()))

    def counters(self) -> dict[str, int]:
        """Return the counters `gaps`, `gap_ms` and `gaps_filled_ms` that are not 0."""
        ms = {"gap_ms": round(1e3 * self.unknown), "gaps_filled_ms": round(1e3 * self.filled)}
        return {name: count for name, count in ({"gaps": self.gaps} | ms).items() if count}

    def set_pose(self, pose: Pose, model: ErrorModel, at_ns: Ns) -> None:
        """Set the pose of base_link in odom, with the uncertainty of an initial pose."""
        self.positions, self.held = plus(self.positions, self.held), AT_REST
        self.pose = Pose(pose.x, pose.y, math.remainder(pose.yaw, math.tau))
        self.path, self.uncertainty = Path(), Uncertainty.initial(model, self.pose)
        self.doubts.forget()
        self.set_ns = at_ns

    def fold(self, line: Line, checks: ConsistencyChecks, model: ErrorModel) -> Estimate:
        """Advance the pose by one plausible line, and return the new estimate.

        A gyro's turn replaces that of the wheels, which then give the distance, and the other wheel
        of its side replaces a faulty one.
        """
        speeds, wheels, gap = line.speeds, checks.wheels, None
        reported, seconds = speeds.as_tuple(), line.dt
        if line.bridged or line.gap or line.vague or self.skipped.lines or seconds > LONG_S:
            commanded = (wheels.commanded or STILL).as_tuple()
            gap = rolled_over(
                self.skipped, line, self.speeds.as_tuple(), self.earlier.as_tuple(), commanded,
                model.independent,
            )  # fmt: skip
            self.skipped = Skipped()
            rolled, seconds = gap.angles, gap.seconds
        else:
            rolled = line.by_counts or times(reported, seconds)
        # Counts are valid even after a silence: the wheels turned by them in its time, too.
        whole = seconds if line.turned is None else seconds + line.gap
        seen = rolled
        if line.turned is not None and not line.count:
            seen = times(reported, seconds)  # the counts seem wrong, which is no fault of a wheel
        elif gap and gap.filled and line.turned is None:
            # The next line confirms a speed behind a silence.
            seen = times(self.speeds.as_tuple(), seconds)
        known = gap is None or not gap.unknown
        checks.check_line(model, line, rolled, seen, whole, known=known)
        turn, slips = checks.turn, checks.slips

        believed = wheels.believed(reported) if wheels.excludes else reported
        self.rested = self.rested + line.dt - line.bridged if believed == AT_REST else 0.0
        at_rest = self.rested > REST_S
        if self.held != AT_REST or (at_rest and rolled != AT_REST):
            rolled = self._beyond_rocking(rolled, at_rest, model)
        self.positions = plus(self.positions, rolled)
        moved = model.kinematics.moved
        linear, angular = moved(believed)
        if wheels.excludes:
            distance, angle = moved(plus(wheels.believed(rolled), wheels.repair))
        else:
            distance, angle = moved(rolled)
        self.doubts.add(wheels, rolled, whole)
        variance = 0.0
        if turn is not None:
            angle, angular, variance = turn.angle, turn.rate, turn.variance
        self.travelled += abs(distance)
        self.twist, self.earlier, self.speeds = Twist(linear, angular), self.speeds, speeds

        pose, path, uncertainty = self.pose, self.path, self.uncertainty
        state = at_rest, slips, turn is not None
        rested, due = self.state[0] and at_rest, state != self.state
        if due:
            uncertainty.update(model, pose, path, slips=self.state[1], by_gyro=self.state[2])
            self.state = state
        share = 0.5 if self.set_ns else 1.0
        way, turned = share * distance, share * angle
        dx, dy, yaw = on_arc(pose.yaw, way, turned)
        self.pose = Pose(pose.x + dx, pose.y + dy, yaw)
        self.path = Path(
            path.way + way, path.turned + turned, path.gyro_variance + variance, path.lines + 1
        )
        # A gap is no period of the lines.
        uncertainty.seconds += seconds - (gap.filled if gap and model.independent == 2 else 0.0)
        if line.late:
            self.late = Twist(
                self.late.linear + linear * line.late, self.late.angular + angular * line.late
            )
        due |= line.doubt is not None or (turn is not None and turn.doubt != 0.0)
        if due or gap or self.set_ns or uncertainty.seconds >= UPDATE_S:
            uncertainty.update(model, self.pose, self.path, slips=slips, by_gyro=turn is not None)
            rate_variance = None if turn is None else turn.rate_variance
            if at_rest:
                uncertainty.set_rest(model, self.rested, slips, rate_variance)
            else:
                uncertainty.set_twist(model, self.twist, line.step, slips, rate_variance)
            heading = yaw - turned / 2
            if self.set_ns:
                uncertainty.doubt((distance / 2) ** 2, (angle / 2) ** 2, 0.0, heading)
            if gap:
                at_ns = line.at.mono_ns
                rests = rested and at_rest and line.driven <= 0.0
                self._doubt_gap(gap, wheels, at_ns, rests, turn is not None, heading, model)
            self.set_ns = 0
            if self.late != REST:
                angle = 0.0 if turn is not None else self.late.angular
                uncertainty.miss("gap", self.late.linear, angle, heading)
                self.late = REST
            if line.doubt is not None:
                distance, angle = model.kinematics.moved(line.doubt)
                uncertainty.miss("gap", distance, 0.0 if turn is not None else angle, heading)
            if turn is not None and turn.doubt:
                uncertainty.miss("gyro", 0.0, turn.doubt, heading)
            found = self.doubts.update(wheels, model.feedback.response_time, model.wheel_count)
            turns = 0.0 if turn is not None else 1.0
            for missed in self._missed(found.ended, model, turns):
                uncertainty.miss(*missed, heading)
            uncertainty.set_open(self._missed(found.open, model, turns), heading)
            for side, angles in found.wheels:
                distance, angle = model.kinematics.moved(angles)
                uncertainty.miss(side, distance, turns * angle, heading)
        return Estimate(
            line.at, self.pose, self.twist, uncertainty.covariance, uncertainty.twist,
            self.positions, speeds, line.asked_ns, line.heard_ns,
        )  # fmt: skip

    @staticmethod
    def _missed(step: Step, model: ErrorModel, turns: float) -> list[tuple[Missed, Metres, Rad]]:
        found = list[tuple[Missed, Metres, Rad]]()
        if step.astray != AT_REST:
            distance, angle = model.kinematics.moved(step.astray)
            of_way, of_turn = SILENT if step.silent else USUAL
            found += [(of_way, distance, 0.0), (of_turn, 0.0, turns * angle)]
        if step.margin != AT_REST:
            distance, angle = model.kinematics.moved(step.margin)
            found.append(("silent range", distance, turns * angle))
        return found

    def _beyond_rocking(self, rolled: Wheels4, at_rest: bool, model: ErrorModel) -> Wheels4:
        # A wheel at rest may rock between the edges of a count.
        rolled, self.held = plus(self.held, rolled), AT_REST
        if at_rest and max(map(abs, rolled)) <= model.unsettled:
            self.held, rolled = rolled, AT_REST
        return rolled

    def _doubt_gap(
        self,
        gap: Rolled,
        wheels: Wheels,
        at_ns: Ns,
        rests: bool,
        by_gyro: bool,
        heading: Rad,
        model: ErrorModel,
    ) -> None:
        uncertainty, filled, unknown = self.uncertainty, gap.filled, gap.unknown
        turns = 0.0 if by_gyro else 1.0  # a gyro misses no turn
        moved, (last, first) = model.kinematics.moved, gap.ends
        for alone in (last.alone, first.alone):
            if alone != AT_REST:
                distance, angle = moved(alone)
                uncertainty.doubt(distance**2, turns * angle**2, 0.0, heading)
        (v, w), (v_after, w_after) = (moved(wheels.believed(end.speeds)) for end in gap.ends)
        linear, angular = v - v_after, w - w_after
        # The speed may have changed at the begin of the lost time, or at its end, and the next time
        # alike: a robot that stops in each silence always stops as late.
        late = filled / 3 + gap.vague / 2
        uncertainty.miss("gap", linear * late, turns * angular * late, heading)
        self.filled += filled
        for seconds in (filled, gap.vague):
            if seconds:
                along, yaw = model.in_gap(seconds, uncertainty.period, rests)
                uncertainty.doubt(along, turns * yaw, 0.0, heading)
        if unknown:
            self.gaps += 1
            self.unknown += unknown
            if self.set_ns:  # the pose was set in the gap
                unknown = max(0.0, min(unknown, (at_ns - self.set_ns) / NS_PER_S))
            half, (along, yaw) = (
                min(unknown, MAX_FILLED_GAP_S) / 2,
                model.in_gap(unknown, uncertainty.period, rests),
            )
            distance, angle = half * (v + v_after), half * (w + w_after)
            uncertainty.miss("gap", distance, turns * angle, heading)
            # The motion may be an arc to either side.
            aside = (distance**2 + along) * min(1.0, (angle**2 + yaw) / 4)
            away, turned = pushed(unknown - MAX_FILLED_GAP_S)
            uncertainty.doubt(along + away, turns * (yaw + turned), aside + away, heading)
