"""Wheel speeds over time -> pose, twist and covariance of base_link in odom.

One step of dt, with left and right the mean wheel speeds of a side (kinematics, equation 1):

    (4)  d_left = r_l left dt            (5)  d_right = r_r right dt
    (6)  d = (d_right + d_left) / 2      (7)  dyaw = (d_right - d_left) / L
    (8)  x += d cos(yaw)                 (9)  y += d sin(yaw)
    (10) yaw += dyaw, wrapped            (11) v = d / dt, w = dyaw / dt

Equations (8) and (9) step along a straight line; the product integrates the exact arc instead:
the chord of an arc of length d through dyaw is d sin(dyaw/2) / (dyaw/2) long and points along
yaw + dyaw/2. They agree as dyaw -> 0.

The covariance is propagated by the arc's Jacobian with noise that grows with the distance and the
angle travelled (Siegwart, Nourbakhsh & Scaramuzza, Introduction to Autonomous Mobile Robots, 5.2).
"""

from __future__ import annotations

import math

from acsard.config.settings import OdometryConfig
from acsard.drive.kinematics import Kinematics
from acsard.mcu.feedback import Feedback
from acsard.mcu.frames import Motors
from acsard.values import REST, STILL, Estimate, Pose, PoseCovariance, WheelSpeeds

MAX_LOST_S = 0.05
"""s of lines that could not be true, up to which the robot is held to have gone on as it did."""

MAX_VARIANCE = 1e9
"""m2 or rad2; a pose this uncertain says nothing, and the numbers must stay finite for years."""


NOWHERE = (0.0, 0.0, 0.0, 0.0)


class Odometry:
    """Integrates feedback; the only state is pose, its covariance and the wheel angles."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics) -> None:
        self._settings = odometry
        self._kinematics = kinematics
        self._positions = NOWHERE
        self._lost_dt, self._lost_turned = 0.0, NOWHERE
        self.twist = REST
        """Twist of the last feedback."""
        self.speeds = STILL
        """Wheel speeds of the last feedback."""
        self.travelled = 0.0
        """m since the start, forwards and backwards."""
        self.set_pose(Pose())

    def set_pose(self, pose: Pose) -> None:
        """Put base_link at `pose` in odom, as certain as at the start; wheel angles go on."""
        diagonal = self._settings.pose_covariance_diagonal
        self._pose = Pose(pose.x, pose.y, math.remainder(pose.yaw, math.tau))
        self._covariance = PoseCovariance(diagonal[0], 0.0, 0.0, diagonal[1], 0.0, diagonal[5])

    @property
    def pose(self) -> Pose:
        """Pose of base_link in odom now."""
        return self._pose

    def skip(self, feedback: Feedback) -> None:
        """Pass over a line that cannot be true: what it should have told is left to the next one.

        Counts are cumulative: what they made of it then stays true. Else only its time is known.
        """
        if feedback.turned is None:
            self._lost_dt += feedback.dt
        else:
            self._lost_turned = _sum(self._lost_turned, feedback.turned)

    def fold(self, feedback: Feedback) -> Estimate:
        """Advance by one feedback line: by its counts, else by its speeds times dt.

        After a gap without counts only the uncertainty advances.
        """
        speeds, turned, gap = feedback.speeds, feedback.turned, feedback.gap
        lost_dt, self._lost_dt = self._lost_dt, 0.0
        lost_turned, self._lost_turned = self._lost_turned, NOWHERE
        # Of lost lines without counts: it went on at about this speed, or too long to guess.
        dt, unknown = (lost_dt, 0.0) if lost_dt <= MAX_LOST_S else (0.0, lost_dt)
        if turned is None:
            turned, dt, unknown = NOWHERE, dt + feedback.dt, unknown + gap
        if unknown > 0.0:
            self._add_gap(unknown)
        twist = self._kinematics.twist(speeds)
        self._move(_sum(turned, lost_turned))
        if feedback.bridged > 0.0:
            self._move(_between(self.speeds, speeds, feedback.bridged))
            dt -= feedback.bridged
        if dt > 0.0:
            self._advance(twist.linear * dt, twist.angular * dt)
            self._positions = _sum(self._positions, _times(speeds.as_tuple(), dt))
        self.twist, self.speeds = twist, speeds
        return Estimate(
            feedback.at,
            self._pose,
            twist,
            self._covariance,
            self._positions,
            speeds,
            feedback.asked_ns,
            feedback.heard_ns,
        )

    def _move(self, turned: Motors) -> None:
        """Advance by these wheel angles in rad: equations (4) to (7) are linear."""
        if turned == NOWHERE:
            return
        moved = self._kinematics.twist(WheelSpeeds(*turned))
        self._advance(moved.linear, moved.angular)
        self._positions = _sum(self._positions, turned)

    def _advance(self, distance: float, turn: float) -> None:
        self.travelled += abs(distance)
        self._covariance = self._propagate(distance, turn)
        self._pose = arc(self._pose, distance, turn)

    def _add_gap(self, gap: float) -> None:
        """The robot may have gone on as it last moved, or stood: one deviation is all of that."""
        p = self._covariance
        if _over(p):
            return
        along = (self.twist.linear * gap) ** 2
        turned = (self.twist.angular * gap) ** 2
        self._covariance = PoseCovariance(
            min(p.xx + along, MAX_VARIANCE),
            p.xy,
            p.xyaw,
            min(p.yy + along, MAX_VARIANCE),
            p.yyaw,
            min(p.yawyaw + turned, MAX_VARIANCE),
        )

    def _propagate(self, distance: float, turn: float) -> PoseCovariance:
        """F P F' + noise, with F the Jacobian of the step in (x, y, yaw)."""
        settings, p = self._settings, self._covariance
        if _over(p):
            return p
        heading = self._pose.yaw + turn / 2
        c, s = math.cos(heading), math.sin(heading)
        fx, fy = -distance * s, distance * c
        along = settings.distance_variance_per_metre * abs(distance)
        turned = settings.yaw_variance_per_metre * abs(distance)
        turned += settings.yaw_variance_per_radian * abs(turn)
        return PoseCovariance(
            p.xx + 2 * fx * p.xyaw + fx * fx * p.yawyaw + along * c * c,
            p.xy + fy * p.xyaw + fx * p.yyaw + fx * fy * p.yawyaw + along * c * s,
            p.xyaw + fx * p.yawyaw,
            p.yy + 2 * fy * p.yyaw + fy * fy * p.yawyaw + along * s * s,
            p.yyaw + fy * p.yawyaw,
            p.yawyaw + turned,
        )


def _sum(a: Motors, b: Motors) -> Motors:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def _times(a: Motors, dt: float) -> Motors:
    return a[0] * dt, a[1] * dt, a[2] * dt, a[3] * dt


def _between(before: WheelSpeeds, after: WheelSpeeds, dt: float) -> Motors:
    """Wheel angles over a time that no line reported: linear from one report to the next."""
    return _times(_sum(before.as_tuple(), after.as_tuple()), dt / 2)


def _over(p: PoseCovariance) -> bool:
    return max(p.xx, p.yy, p.yawyaw) >= MAX_VARIANCE


def arc(pose: Pose, distance: float, turn: float) -> Pose:
    """`pose` after an arc of length `distance` m through `turn` rad."""
    half = turn / 2
    # sin(h)/h loses nothing in doubles down to tiny h; only h = 0 needs its limit.
    chord = distance * (math.sin(half) / half if half else 1.0)
    heading = pose.yaw + half
    return Pose(
        pose.x + chord * math.cos(heading),
        pose.y + chord * math.sin(heading),
        math.remainder(pose.yaw + turn, math.tau),
    )
