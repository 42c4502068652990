"""Integrates wheel speeds into pose, twist and covariance of base_link in odom.

The equations of one step of dt s, where left and right are the mean wheel speeds of the two sides
(`kinematics.py`, equation 1), are

    (4)  d_left = r_l left dt            (5)  d_right = r_r right dt
    (6)  d = (d_right + d_left) / 2      (7)  dyaw = (d_right - d_left) / L
    (8)  x += d cos(yaw)                 (9)  y += d sin(yaw)
    (10) yaw += dyaw, wrapped            (11) v = d / dt, w = dyaw / dt

Equations (8) and (9) step along a straight line; `path.py` integrates the exact arc instead. Line
and arc agree in the limit dyaw -> 0.
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
    Twist,
    TwistVariances,
    WheelSpeeds,
)

MISSED_STD = math.sqrt(0.5)
"""Standard deviation of a motion that the pose may have missed, as a fraction of this motion. The
pose has missed the motion with the probability 1/2: the board may have received the command to rest
in a gap or not, and a wheel that contradicts another one or its command may be right or not."""

MAX_RECOMPUTED_LINES = 128
"""Largest number of feedback lines that are recomputed when a wheel proves faulty."""


class Step(Struct, frozen=True, gc=False):
    """One step of the pose: the motion that one feedback line added to it.

    The odometry keeps it to recompute the pose if a wheel proves faulty.
    """

    pose: Pose
    """The pose before the feedback line."""
    pieces: tuple[Motors, ...]
    """Angles that the wheels rolled since the previous feedback line, rad, one item for each
    arc."""
    gyro: Turn | None
    """The turn that a gyro measured; None if the wheels provided the turn."""
    speeds: WheelSpeeds
    turn: float
    """Change of the heading that this line caused, rad."""
    on_trial: bool
    """Whether the wheels provided the turn because the gyro was not proven. A gyro is proven when
    it has agreed with the wheels in a turn."""


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
        """Start at the origin.

        `encoder_counts` is the number of counts per revolution of a wheel; 0 if it is unknown.
        `quiet` is the time without feedback after which the daemon commands rest, s.
        """
        self._kinematics = kinematics
        self._positions = AT_REST
        self._rolling = Rolling(quiet)
        self._confirmation = Confirmation(feedback)
        self._held = AT_REST
        """Angles that the wheels have rolled at rest, rad. The odometry adds these angles to the
        pose when they exceed two encoder counts (`_unsettled`) or when the robot drives."""
        self._steps_of, self._coarsest, self._largest_step = AT_REST, 0.0, 0.0
        """`_steps_of` contains the quantization step of each wheel's speed in the last line, rad/s.
        `_coarsest` and `_largest_step` are the largest of these steps that is known, rad/s. If no
        step is known, `_coarsest` is 0 and `_largest_step` is infinite."""
        self._path = Path()
        self._errors = ErrorModel(odometry, kinematics)
        self._uncertainty = PoseUncertainty(self._errors, encoder_counts)
        self._twist_uncertainty = TwistUncertainty(self._errors, encoder_counts)
        self._gaps, self._rounding = Gaps(), Rounding()
        self.checks = ConsistencyChecks(odometry, kinematics, encoder_counts, feedback)
        self._steps: deque[Step] = deque(maxlen=MAX_RECOMPUTED_LINES)
        self._unsettled = 2 * math.tau / (encoder_counts or ASSUMED_COUNTS)
        """Angle of two encoder counts, rad. If a wheel at rest rocks between the edges of one
        count, the reported angle is not larger than this."""
        self._still = 0.0
        """Time for which all wheel speeds have been zero, s, without filled gaps."""
        self.twist = REST
        """Twist in the last feedback line, m/s and rad/s."""
        self.speeds = STILL
        """Wheel speeds in the last feedback line, rad/s."""
        self._commanded = self._highest = REST
        """`_commanded` is the twist that was commanded last. `_highest` contains the highest linear
        and angular speed that was commanded since the last feedback line, both without sign."""
        self._folded = False
        """Whether a feedback line was used since the last command."""
        self.gaps, self.unseen, self.bridged = 0, 0.0, 0.0
        """Statistics of the gaps in the feedback. `gaps` and `unseen` are the number and the total
        duration, s, of the gaps in which the robot may have moved but the pose could not follow.
        `bridged` is the total duration of the gaps that were filled, s."""
        self.travelled = 0.0
        """Distance driven since the start of the daemon, forwards plus backwards, m."""

    def use(self, odometry: OdometryConfig) -> None:
        """Use the variances in `odometry` from now on.

        The variances of the initial pose apply from the next call of `set_pose` on.
        """
        self._errors.use(odometry)

    def set_pose(self, pose: Pose) -> None:
        """Set the pose of base_link in odom, with the uncertainty of an initial pose.

        Some motion is not in the pose yet, for example the motion in feedback lines that are held
        back or implausible. This motion is dropped, because it happened before this call. However,
        a small motion at rest (`_held`) is still added to the angles of the wheels. If this call
        comes in a silence of the board, the next line still adds the motion of the whole silence.
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
        """The present pose of base_link in odom."""
        return self._path.pose

    def missed(self) -> dict[str, int]:
        """Return counters of the gaps in the feedback by name, without counters that are 0.

        `gaps` is the number of gaps in which the robot may have moved but the pose could not
        follow, and `gap_ms` is their total duration, ms. `gaps_filled_ms` is the total duration of
        filled gaps, ms.
        """
        ms = {"gap_ms": round(1e3 * self.unseen), "gaps_filled_ms": round(1e3 * self.bridged)}
        return {name: count for name, count in ({"gaps": self.gaps} | ms).items() if count}

    def command(self, twist: Twist) -> None:
        """Record the twist, m/s and rad/s, that the motors are commanded from now on.

        The daemon calls this in each control step, after the feedback lines of this step. In a gap
        of the feedback, the robot may have driven as fast as the recorded twists.
        """
        if self._folded or twist != self._commanded:
            # The robot may still follow the previous command, because the board reacts late.
            highest = self._commanded if self._folded else self._highest
            self._highest = Twist(
                max(abs(highest.linear), abs(twist.linear)),
                max(abs(highest.angular), abs(twist.angular)),
            )
            self._commanded, self._folded = twist, False

    def skip(self, feedback: Feedback) -> None:
        """Ignore the speeds of an implausible feedback line (see `sanity.py`).

        The next plausible line adds the motion of both lines to the pose. If `feedback` has encoder
        counts, its motion comes from these counts.
        """
        self._rolling.skip(feedback)

    def confirmed(self, feedback: Feedback) -> tuple[list[Feedback], int]:
        """Return the feedback lines to pass to `fold`, and the number of lines that were dropped.

        `feedback` is the next plausible line. It is held back for a later call if it covers a long
        time and reports a speed that neither another wheel nor another line confirms yet. The
        returned lines are in the order of time. The time of a dropped line counts as a gap.
        """
        rolling, believed = self._rolling, self.checks.wheels.believed
        lines, dropped = self._confirmation.confirm(
            feedback, rolling.skipped, self.speeds, believed
        )
        for line in dropped:
            rolling.skip(replace(line, bridged=line.dt))
        return lines, len(dropped)

    def fold(self, feedback: Feedback) -> Estimate:
        """Advance the pose by one feedback line, and return the new estimate.

        - The angles that the wheels rolled come from the encoder counts of the line. Without
          counts, each angle is the speed of the wheel times dt. After a gap that cannot be filled,
          only the uncertainty grows.
        - While the robot is at rest, a motion of up to two encoder counts does not change the pose
          yet.
        - If a gyro provides the turn since the previous line, the wheels provide only the distance.
        - If a wheel proves faulty, the other wheel of its side replaces it, also in the earlier
          lines in which the faulty wheel was wrong.
        """
        speeds, dt, before, checks = feedback.speeds, feedback.dt, self.twist, self.checks
        rolled = self._rolling.take(feedback, self.speeds)
        if feedback.steps is not self._steps_of:
            self._steps_of = feedback.steps
            known = [step for step in feedback.steps if step < math.inf]
            self._coarsest = max(known, default=0.0)
            self._largest_step = max(known, default=math.inf)
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
        self._rounding.add(believed, own, self._still, after_gap, self._largest_step)
        if rolled.unknown > 0.0:
            self._add_unseen_motion(rolled.unknown, before, twist)
        turned = self._move(self._settled(rolled, at_rest), turn, speeds, slips)
        for side, angles in checks.wheels.possible_motion(rolled.seen):
            self._miss(side, angles, turn)
        self._go_on(rolled, feedback, before, twist)
        variances = self._twist_variances(twist, feedback, at_rest, turn, slips)
        if turn is not None and dt > 0.0:
            twist = Twist(linear, turn.rate)
        self.twist, self.speeds, self._folded = twist, speeds, True
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
        """Return the wheel angles to add to the pose now, rad, one item for each arc.

        A small motion at rest is stored in `_held` and not returned yet, because a wheel at rest
        may rock between the edges of one encoder count.
        """
        turned = rolled.turned
        if self._held != AT_REST:
            turned = plus(self._held, turned)
        if turned == AT_REST:
            # The wheels have turned back by the held motion.
            self._held = AT_REST
            return rolled.pieces
        if at_rest and max(map(abs, turned)) <= self._unsettled:
            self._held = turned
            return rolled.pieces
        self._held = AT_REST
        return (turned, *rolled.pieces)

    def _take_back(self) -> None:
        """Recompute the pose over the recent lines in which the newly faulty wheel was wrong.

        If a gyro was proven meanwhile and has corrected the heading, the heading does not change.
        """
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
        """Return the arcs that the robot drove, as pairs of distance (m) and turn (rad).

        `pieces` contains the angles that the wheels rolled, rad, one item for each arc. If `gyro`
        is not None, the result is a single arc with the gyro's turn.
        """
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
        """Advance the pose, and return its turn, rad. `turn` is the turn according to a gyro."""
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
        """Add the uncertainty of a filled gap; without a gap, measure the robot's acceleration.

        A gap that was not filled restarts the measurement.
        """
        bridged = rolled.bridged
        if bridged > 0.0:
            self.bridged += bridged
            along, yaw = self._gaps.fill(bridged, before, twist, self._highest)
            by_counts, turn_by_counts = self._rounded(bridged)
            self._uncertainty.doubt(along + by_counts, yaw + turn_by_counts)
            if rolled.missed != AT_REST:
                self._miss("gap", self.checks.wheels.believed(rolled.missed), self.checks.turn)
        elif feedback.gap:
            self._gaps.interrupt(twist)
        else:
            self._gaps.follow(twist, feedback.dt)

    def _miss(self, cause: Missed, angles: Motors, gyro: Turn | None) -> None:
        """Add the uncertainty because the wheels may have rolled `angles`, rad, in addition.

        `gyro` is the turn that a gyro measured, or None.
        """
        distance, turn = self._kinematics.moved(angles)
        # A gyro does not miss a turn.
        turn = turn if gyro is None else 0.0
        self._uncertainty.miss(cause, MISSED_STD * distance, MISSED_STD * turn)
        if cause == "gap":
            # The board may also have received the command in some gaps and not in others. Motions
            # of opposite directions would cancel in the common part.
            self._uncertainty.doubt(distance**2 / 4, turn**2 / 4)

    def _twist_variances(
        self, twist: Twist, feedback: Feedback, at_rest: bool, gyro: Turn | None, slips: bool
    ) -> TwistVariances:
        spread, step = self._twist_uncertainty, self._coarsest
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
        """Return the variances that rounding to encoder counts causes in a gap of the feedback.

        The gap takes `seconds` s. The result is the pair of the variances of the distance (m2) and
        of the turn (rad2). The second one is 0 if a gyro provides the turn.
        """
        linear, angular = self._twist_uncertainty.rounding(self._rounding.square)
        square = seconds * seconds
        return linear * square, 0.0 if self.checks.turn is not None else angular * square

    def _add_unseen_motion(self, seconds: float, before: Twist, after: Twist) -> None:
        """Add the uncertainty of `seconds` s of unknown motion, but do not move the pose."""
        if before != REST or after != REST or self._highest != REST:
            self.gaps += 1
            self.unseen += seconds
        along, yaw = self._gaps.unseen(seconds, before, after, self._highest)
        by_counts, turn_by_counts = self._rounded(seconds)
        self._uncertainty.add_gap(
            seconds * (before.linear + after.linear) / 2,
            seconds * (before.angular + after.angular) / 2,
            along + by_counts,
            yaw + turn_by_counts,
        )
