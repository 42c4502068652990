"""Integrates wheel speeds into pose, twist and covariance of base_link in odom.

    (4)  d_left = r_l left dt            (5)  d_right = r_r right dt
    (6)  d = (d_right + d_left) / 2      (7)  dyaw = (d_right - d_left) / L
    (8)  x += d cos(yaw)                 (9)  y += d sin(yaw)
    (10) yaw += dyaw, wrapped            (11) v = d / dt, w = dyaw / dt

`left` and `right` are of `kinematics.py`, equation 1. Instead of (8) and (9), `path.py` integrates
the exact arc, whose limit they are for dyaw -> 0.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import takewhile

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import FeedbackConfig, OdometryConfig
from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.motion.consistency import ConsistencyChecks
from acsard.core.motion.error_model import ErrorModel, TwistUncertainty
from acsard.core.motion.gap_filling import (
    AT_REST,
    Confirmation,
    Gaps,
    Rolled,
    Rolling,
    Rounding,
    plus,
)
from acsard.core.motion.gyro import REST_S, Turn
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.path import Path
from acsard.core.motion.uncertainty import ASSUMED_COUNTS, Missed, PoseUncertainty
from acsard.core.values import (
    REST,
    STILL,
    Estimate,
    Pose,
    RadPerS,
    Twist,
    TwistVariances,
    WheelSpeeds,
)

# Fraction of a motion that the pose has missed with the probability 1/2: the board may have got the
# command to rest in a gap or not, and a wheel that is contradicted may be right or not.
MISSED_STD = math.sqrt(0.5)

MAX_RECOMPUTED_LINES = 128  # when a wheel proves faulty


class Step(Struct, frozen=True, gc=False):
    """The motion that one line added to the pose, kept for a recomputation without a wheel."""

    pose: Pose  # before the line
    pieces: tuple[Motors, ...]  # rolled since the previous line, rad, one item for each arc
    gyro: Turn | None  # None: the wheels provided the turn
    speeds: WheelSpeeds
    turn: float  # of the heading by this line, rad
    # The wheels provided the turn, because the gyro has not agreed with them in a turn yet.
    on_trial: bool


class Commanded(Struct):
    """The speeds that the motors were commanded, without signs."""

    speeds: Twist = REST
    # Since the last line: in a gap, the robot may have driven as fast, or it may still follow the
    # previous command.
    highest: Twist = REST

    def command(self, twist: Twist) -> None:
        """Record the twist that the motors are commanded from now on."""
        linear, angular, highest = abs(twist.linear), abs(twist.angular), self.highest
        self.speeds = Twist(linear, angular)
        if linear > highest.linear or angular > highest.angular:
            self.highest = Twist(max(highest.linear, linear), max(highest.angular, angular))

    def begin_line(self) -> None:
        """Record that a line was used, so that the speeds of the next one begin."""
        self.highest = self.speeds


class Unseen(Struct):
    """Gaps in the feedback, in which the robot may have moved."""

    gaps: int = 0
    seconds: float = 0.0
    filled: float = 0.0  # s of gaps that were filled

    def counters(self) -> dict[str, int]:
        """Return the counters `gaps`, `gap_ms` and `gaps_filled_ms` that are not 0."""
        ms = {"gap_ms": round(1e3 * self.seconds), "gaps_filled_ms": round(1e3 * self.filled)}
        return {name: count for name, count in ({"gaps": self.gaps} | ms).items() if count}


class Quantization(Struct):
    """Quantization of the speeds in the last line, rad/s."""

    steps: Motors = AT_REST
    coarsest: RadPerS = 0.0  # the largest known one, 0 if none is known
    largest: RadPerS = math.inf  # the same, but infinite

    def follow(self, steps: Motors) -> None:
        if steps is self.steps:
            return
        known = [step for step in steps if step < math.inf]
        self.coarsest, self.largest = max(known, default=0.0), max(known, default=math.inf)
        self.steps = steps


class Odometry:
    """The odometry: pose, covariance and angles of the wheels, integrated from feedback."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int = 0,
        feedback: FeedbackConfig = FeedbackConfig(),  # noqa: B008
        quiet: float = math.inf,
    ) -> None:
        # `encoder_counts` per revolution is 0 if unknown; after `quiet` s without feedback, the
        # daemon commands rest.
        self._kinematics = kinematics
        self._positions = AT_REST
        self._rolling = Rolling(quiet)
        self._confirmation = Confirmation()
        self._held = AT_REST  # rad at rest; for the pose beyond two counts, or in a drive
        self._quantization = Quantization()
        self._path = Path()
        self._errors = ErrorModel(odometry, kinematics)
        self._uncertainty = PoseUncertainty(self._errors, encoder_counts)
        self._twist_uncertainty = TwistUncertainty(self._errors, encoder_counts)
        self._gaps, self._rounding = Gaps(), Rounding()
        self.checks = ConsistencyChecks(odometry, kinematics, encoder_counts, feedback)
        self._steps: deque[Step] = deque(maxlen=MAX_RECOMPUTED_LINES)
        # Two counts, rad: a wheel at rest rocks between the edges of one.
        self._unsettled = 2 * math.tau / (encoder_counts or ASSUMED_COUNTS)
        self._still = 0.0  # s of zero speeds, without filled gaps
        self.twist = REST  # in the last line
        self.speeds = STILL  # in the last line
        self.commanded, self.unseen = Commanded(), Unseen()
        self.travelled = 0.0  # m since the daemon started, forwards plus backwards

    def use(self, odometry: OdometryConfig) -> None:
        """Use other variances; those of the initial pose apply from the next `set_pose`."""
        self._errors.use(odometry)

    def set_pose(self, pose: Pose) -> None:
        """Set the pose of base_link in odom, with the uncertainty of an initial pose.

        Motion that is not in the pose yet is dropped, because it was before this call; only `_held`
        still turns the wheels. A silence that goes on is added by the next line as a whole.
        """
        self._positions = plus(self._positions, self._held)
        self._held = AT_REST
        self._confirmation.forget()
        self._rolling.forget()
        self._path.set(pose)
        self._steps.clear()
        self._uncertainty.set(pose.yaw)
        self.checks.drop_corrections()

    @property
    def pose(self) -> Pose:
        return self._path.pose

    def skip(self, feedback: Feedback) -> None:
        """Ignore the speeds of an implausible line; the next plausible one adds both motions.

        With encoder counts, its motion comes from these.
        """
        self._rolling.skip(feedback)

    def confirmed(self, feedback: Feedback) -> tuple[list[Feedback], int]:
        """Return the lines for `fold`, in the order of time, and how many were dropped.

        The next plausible line is held back if it covers a long time with a speed that nothing
        confirms yet. The time of a dropped line is a gap.
        """
        rolling, believed = self._rolling, self.checks.wheels.believed
        lines, dropped = self._confirmation.confirm(
            feedback, rolling.skipped, self.speeds, believed
        )
        for line in dropped:
            rolling.skip(replace(line, bridged=line.dt))
        return lines, len(dropped)

    def fold(self, feedback: Feedback) -> Estimate:
        """Advance the pose by one line, and return the new estimate.

        Angles come from encoder counts, or else speeds times dt; after a gap that cannot be filled,
        only the uncertainty grows. At rest, up to two counts do not change the pose yet. With a
        gyro's turn, the wheels provide only the distance. The other wheel of its side replaces a
        faulty one, also in earlier lines.
        """
        speeds, dt, before, checks = feedback.speeds, feedback.dt, self.twist, self.checks
        rolled = self._rolling.take(feedback, self.speeds)
        self._quantization.follow(feedback.steps)
        if checks.check_line(feedback, rolled):
            self._take_back()
        turn, slips = checks.turn, checks.slips
        believed = checks.wheels.believed(speeds.as_tuple())
        linear, angular = self._kinematics.moved(believed)
        twist = Twist(linear, angular)
        own = dt - feedback.bridged
        self._still = self._still + own if believed == AT_REST else 0.0
        at_rest = self._still > REST_S
        after_gap = rolled.bridged > 0.0 or rolled.unknown > 0.0
        self._rounding.add(believed, own, self._still, after_gap, self._quantization.largest)
        if rolled.unknown > 0.0:
            self._add_unseen_motion(rolled.unknown, before, twist)
        turned = self._move(self._settled(rolled, at_rest), turn, speeds, slips)
        for side, angles in checks.wheels.possible_motion(rolled.seen):
            self._miss(side, angles, turn)
        self._go_on(rolled, feedback, before, twist)
        variances = self._twist_variances(twist, feedback, at_rest, turn, slips)
        if turn is not None and dt > 0.0:
            twist = Twist(linear, turn.rate)
        self.twist, self.speeds = twist, speeds
        self.commanded.begin_line()
        checks.finish(turned)
        return Estimate(
            feedback.at,
            self._path.pose,
            twist,
            self._uncertainty.covariance,
            variances,
            self._positions,
            speeds,
            feedback.asked_ns,
            feedback.heard_ns,
        )

    def _settled(self, rolled: Rolled, at_rest: bool) -> tuple[Motors, ...]:
        # A wheel may rock between the edges of a count.
        turned = rolled.turned
        if self._held != AT_REST:
            turned = plus(self._held, turned)
        if turned == AT_REST:
            self._held = AT_REST
            return rolled.pieces
        if at_rest and max(map(abs, turned)) <= self._unsettled:
            self._held = turned
            return rolled.pieces
        self._held = AT_REST
        return (turned, *rolled.pieces)

    def _take_back(self) -> None:
        # A gyro that was proven meanwhile has corrected the heading already.
        was_faulty = self.checks.wheels.was_faulty
        wrong = list(takewhile(lambda step: was_faulty(step.speeds), reversed(self._steps)))
        if not wrong:
            return
        self._path.set(wrong[-1].pose)
        on_trial = 0.0
        for step in reversed(wrong):
            arcs = self._arcs(step.pieces, step.gyro)
            for distance, angle in arcs:
                self._path.advance(distance, angle)
            for piece in step.pieces:
                for side, angles in self.checks.wheels.possible_motion_before(piece):
                    self._miss(side, angles, step.gyro)
            if step.on_trial:
                on_trial += math.fsum([angle for _, angle in arcs]) - step.turn
        self._steps.clear()
        if on_trial:
            self._path.turn(-self.checks.undo_recomputation(on_trial))

    def _arcs(self, pieces: tuple[Motors, ...], gyro: Turn | None) -> list[tuple[float, float]]:
        believed, kinematics = self.checks.wheels.believed, self._kinematics
        arcs = []
        for piece in pieces:
            distance, angle = kinematics.moved(believed(piece))
            arcs.append((distance, angle))
        if gyro is not None:
            return [(math.fsum([distance for distance, _ in arcs]), gyro.angle)]
        return arcs

    def _move(
        self,
        pieces: tuple[Motors, ...],
        turn: Turn | None,
        speeds: WheelSpeeds,
        slips: bool,
    ) -> float:
        # Returns the turn of the pose, rad.
        path, turned = self._path, 0.0
        pose, variance = path.pose, None if turn is None else turn.variance
        for piece in pieces:
            self._positions = plus(self._positions, piece)
        for distance, angle in self._arcs(pieces, turn):
            turned += angle
            self.travelled += abs(distance)
            dx, dy, heading = path.advance(distance, angle)
            self._uncertainty.advance(distance, angle, dx, dy, heading, variance, slips)
        on_trial = self.checks.on_trial
        self._steps.append(Step(pose, pieces, turn, speeds, turned, on_trial))
        return turned

    def _go_on(self, rolled: Rolled, feedback: Feedback, before: Twist, twist: Twist) -> None:
        bridged = rolled.bridged
        if bridged > 0.0:
            self.unseen.filled += bridged
            along, yaw = self._gaps.fill(bridged, before, twist, self.commanded.highest)
            by_counts, turn_by_counts = self._rounded(bridged)
            self._uncertainty.doubt(along + by_counts, yaw + turn_by_counts)
            if rolled.missed != AT_REST:
                self._miss("gap", self.checks.wheels.believed(rolled.missed), self.checks.turn)
        elif feedback.gap:
            self._gaps.interrupt(twist)
        else:
            self._gaps.follow(twist, feedback.dt)

    def _miss(self, cause: Missed, angles: Motors, gyro: Turn | None) -> None:
        distance, turn = self._kinematics.moved(angles)
        turn = turn if gyro is None else 0.0  # a gyro misses none
        self._uncertainty.miss(cause, MISSED_STD * distance, MISSED_STD * turn)
        if cause == "gap":
            # The board may also have received the command in some gaps and not in others. Motions
            # of opposite directions would cancel in the common part.
            self._uncertainty.doubt(distance**2 / 4, turn**2 / 4)

    def _twist_variances(
        self, twist: Twist, feedback: Feedback, at_rest: bool, gyro: Turn | None, slips: bool
    ) -> TwistVariances:
        spread, step = self._twist_uncertainty, self._quantization.coarsest
        if at_rest:
            variances = spread.at_rest(self._still, step)
        else:
            variances = spread.of(twist, feedback.dt - feedback.bridged, step)
        if slips:
            variances = spread.slipping(variances)
        if gyro is not None and feedback.dt > 0.0:
            variances = spread.with_gyro(variances, gyro.rate_variance)
        return variances

    def _rounded(self, seconds: float) -> tuple[float, float]:
        # Variances of distance, m2, and turn, rad2 (0 with a gyro).
        linear, angular = self._twist_uncertainty.rounding(self._rounding.square)
        square = seconds * seconds
        return linear * square, 0.0 if self.checks.turn is not None else angular * square

    def _add_unseen_motion(self, seconds: float, before: Twist, after: Twist) -> None:
        if before != REST or after != REST or self.commanded.highest != REST:
            self.unseen.gaps += 1
            self.unseen.seconds += seconds
        along, yaw = self._gaps.unseen(seconds, before, after, self.commanded.highest)
        by_counts, turn_by_counts = self._rounded(seconds)
        self._uncertainty.add_gap(
            seconds * (before.linear + after.linear) / 2,
            seconds * (before.angular + after.angular) / 2,
            along + by_counts,
            yaw + turn_by_counts,
        )
