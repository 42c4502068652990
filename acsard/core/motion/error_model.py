"""The error model of the odometry: noise of a step, errors of parameters, and errors of the twist.

A step is the motion from one feedback line to the next. In a step, the left and the right side of
the robot roll the distances dl and dr, m. The errors of these distances are independent and have
the variances k |dl| and k |dr|, where k is in m (Siegwart, Nourbakhsh & Scaramuzza, Introduction to
Autonomous Mobile Robots, 5.2.4). Let L be the effective track, m. The step has the distance d = (dl
+ dr) / 2 and the turn dyaw = (dr - dl) / L. The errors of d and dyaw therefore have

    var(d) = k (|dl| + |dr|) / 4
    var(dyaw) = k (|dl| + |dr|) / L^2
    cov(d, dyaw) = k (|dr| - |dl|) / (2 L)

Skidding adds the variance `yaw_variance_per_radian` to dyaw for each radian that the robot turns.
The errors of parameters, such as a wheel radius, do not average out, so they are not noise
(Borenstein & Feng, Measurement and Correction of Systematic Odometry Errors in Mobile Robots,
1996). `columns` returns one `Column` for each parameter.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Twist, TwistVariances

Column = tuple[float, float, float, float]
"""Error of the distance and the turn of a step if one parameter is off by one standard deviation.

The first two numbers are the error of the distance per m of distance and per rad of turn (m/m,
m/rad). The last two numbers are the error of the turn per m of distance and per rad of turn (rad/m,
rad/rad). A parameter is, for example, a wheel radius.
"""

SLIP_FACTOR = 100.0
"""Factor by which slip of the wheels increases the variances of a step and of the twist."""

SPEED_RESOLUTION = 0.01
"""Resolution of the wheel speeds in a feedback line, rad/s. The line has two decimals."""

MAX_TWIST_VARIANCE = 1e9
"""Largest variance of a twist, m2/s2 and rad2/s2. It means "unknown"."""

LATERAL_VARIANCE = 1e-3
"""Variance of the sideways speed of a robot that moves, m2/s2. Wheels do not measure this speed."""

MIN_TWIST_VARIANCE = 1e-8
"""Smallest variance of a twist, m2/s2 and rad2/s2. Filters that use the published twist treat a
smaller variance as an error."""

ASSUMED_PERIOD_S = 0.01
"""Assumed period of the feedback lines before it is measured, s."""

PERIOD_GAIN = 0.05
"""Weight of the newest period in the running mean of the time between feedback lines. The weight is
small, because periods vary: several lines may be read at the same time."""


class Noise:
    """Computes the variances and the covariance of the errors of distance and turn in one step."""

    def __init__(self, odometry: OdometryConfig, track: float) -> None:
        """Take the variances from `odometry`. `track` is the effective track, m."""
        # The settings can describe more errors than those of the two sides. If the sides were the
        # only cause of errors, `distance_variance_per_metre` D would be k / 2, and
        # `yaw_variance_per_metre` Y would be 2 k / L^2. Therefore the sides get k = min(2 D,
        # Y L^2 / 2). The remaining part of D or Y is an error of the robot as a whole.
        wheels = min(
            2 * odometry.distance_variance_per_metre,
            odometry.yaw_variance_per_metre * track * track / 2,
        )
        self._along = odometry.distance_variance_per_metre - wheels / 2
        self._yaw = odometry.yaw_variance_per_metre - 2 * wheels / (track * track)
        self._skid = odometry.yaw_variance_per_radian
        self._half = track / 2
        self._to_along = wheels / 4
        self._to_yaw = wheels / (track * track)
        self._to_both = wheels / (2 * track)

    def of(self, distance: float, turn: float, turned: float) -> tuple[float, float, float]:
        """Return var(d) in m2, var(dyaw) in rad2 and cov(d, dyaw) in m rad for a step.

        Args:
            distance: the distance d of the step, m.
            turn: the turn dyaw of the step, rad.
            turned: the part of |turn| that is a real turn and not encoder noise, rad. Only this
                part has the variance for skidding.
        """
        left, right = abs(distance - self._half * turn), abs(distance + self._half * turn)
        path, sides = abs(distance), left + right
        return (
            self._along * path + self._to_along * sides,
            self._yaw * path + self._to_yaw * sides + self._skid * turned,
            self._to_both * (right - left),
        )


class ErrorModel:
    """The noise of an odometry step, and the effects of parameter errors on this step."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics) -> None:
        self.radius = kinematics.radius
        """Mean radius of the wheels, m."""
        self.settings = odometry
        self.track = kinematics.track
        self.columns = columns(odometry, kinematics)
        self.noise = Noise(odometry, self.track)

    def use(self, odometry: OdometryConfig) -> None:
        """Use the noise settings in `odometry` from now on, and keep the parameter errors."""
        self.settings = odometry
        self.noise = Noise(odometry, self.track)


def columns(odometry: OdometryConfig, kinematics: Kinematics) -> tuple[Column, ...]:
    """Return the effects of all uncertain parameters on a step: one `Column` for each parameter.

    The equations of a step are

        dl = r m_l phi_l,   dr = r m_r phi_r,   dyaw = (dr - dl) / (m_L b)

    where r is `wheel_radius`, b is `wheel_separation`, and phi_l and phi_r are the angles that the
    wheels rolled.

    The parameters are the multipliers m_l, m_r and m_L, the ratio m_r / m_l, a scale that
    multiplies all lengths, and the fraction of each distance that the wheels lose by slip. The
    scale and the slip share one column. The standard deviations of these parameters come from
    `odometry`. A parameter with a standard deviation of 0 has no column.

    """
    track = kinematics.track
    left, right, separation = kinematics.multipliers
    rows = []
    if odometry.left_wheel_radius_multiplier_std:
        share = odometry.left_wheel_radius_multiplier_std / left
        rows.append((share / 2, -share * track / 4, -share / track, share / 2))
    if odometry.right_wheel_radius_multiplier_std:
        share = odometry.right_wheel_radius_multiplier_std / right
        rows.append((share / 2, share * track / 4, share / track, share / 2))
    if odometry.wheel_separation_multiplier_std:
        share = odometry.wheel_separation_multiplier_std / separation
        rows.append((0.0, 0.0, 0.0, -share))
    if odometry.wheel_radius_ratio_std:
        # One radius is larger by half of the ratio's error, and the other is smaller by that half.
        share = odometry.wheel_radius_ratio_std
        rows.append((0.0, share * track / 4, share / track, 0.0))
    # The scale multiplies radii and track alike, so it does not change turns. Permanent slip has
    # the same effect on the distance.
    if scale := math.hypot(odometry.distance_scale_std, odometry.wheel_slip_std):
        rows.append((scale, 0.0, 0.0, 0.0))
    return tuple(rows)


class TwistUncertainty:
    """Computes the variances of the twist that a feedback line reports.

    v is the linear speed and w the turn rate of the line. Their variances are

        var(v) = a_v q^2 / 12 + var(d) / T^2 + sum of (c_1 v + c_2 w)^2
        var(w) = a_w q^2 / 12 + var(dyaw) / T^2 + sum of (c_3 v + c_4 w)^2

    - q is the quantization step of the wheel speeds. Each wheel has the variance q^2 / 12. a_v and
      a_w follow from the kinematics, with two wheels on each side.
    - T is the mean period of the feedback lines. A line reports the mean speed over one period.
    - var(d) and var(dyaw) are the noise of one period. Because of these terms, a pose that a
      program integrates from the twists is as uncertain as the pose of the odometry.
    - The sums are over the uncertain parameters of the kinematics (c_1 to c_4: see `columns`).

    If the wheels slip, `slipping` multiplies the variances by `SLIP_FACTOR`. For a robot at rest,
    `at_rest` returns smaller variances: they cover only a motion that is too slow for the encoders
    to show.
    """

    def __init__(self, model: ErrorModel, counts: int) -> None:
        """Start with a feedback period of `ASSUMED_PERIOD_S`.

        `counts` is the number of encoder counts per revolution of a wheel; 0 if it is unknown.
        """
        self._model = model
        self._count = math.tau / counts if counts else 0.0
        # The errors of the four wheels are independent, and each side is the mean of two wheels.
        self._to_linear = model.radius**2 / 4 / 12
        self._period = ASSUMED_PERIOD_S
        self._to_angular = model.radius**2 / model.track**2 / 12

    def of(self, twist: Twist, dt: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of the twist of a feedback line.

        Args:
            twist: the twist that the line reports, m/s and rad/s.
            dt: the time since the previous feedback line, s; 0 if it is unknown.
            step: the quantization step of the wheel speeds in the feedback lines, rad/s; 0 if it is
                unknown.
        """
        if dt > 0.0:
            # A single late line, or a line after lost lines, does not mean a longer period.
            self._period += PERIOD_GAIN * (min(dt, 2 * self._period) - self._period)
        model, period, linear, angular = self._model, self._period, twist.linear, twist.angular
        quantum = max(SPEED_RESOLUTION, self._count / period, step) ** 2
        along, yaw, _ = model.noise.of(linear, angular, abs(angular))
        along, yaw = along / period, yaw / period
        for to_along, by_turn, to_yaw, of_turn in model.columns:
            along += (to_along * linear + by_turn * angular) ** 2
            yaw += (to_yaw * linear + of_turn * angular) ** 2
        along += self._to_linear * quantum
        yaw += self._to_angular * quantum
        # Do not call `max` here: three calls take half as long as all lines above.
        return TwistVariances(
            along if along > MIN_TWIST_VARIANCE else MIN_TWIST_VARIANCE,
            LATERAL_VARIANCE,
            yaw if yaw > MIN_TWIST_VARIANCE else MIN_TWIST_VARIANCE,
        )

    def at_rest(self, seconds: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of the twist of a robot at rest.

        `seconds` is the time for which all wheels have reported zero speed, s. `step` is the
        quantization step of the wheel speeds, rad/s; 0 if it is unknown.
        """
        linear, angular = self.rounding((max(self._count, step * self._period) / seconds) ** 2)
        return TwistVariances(
            max(MIN_TWIST_VARIANCE, linear),
            MIN_TWIST_VARIANCE,
            max(MIN_TWIST_VARIANCE, angular),
        )

    def rounding(self, square: float) -> tuple[float, float]:
        """Return the variances of the twist that the quantization of the wheel speeds causes.

        The result is a pair: the variances of the linear speed, m2/s2, and of the turn rate,
        rad2/s2. `square` is the square of the quantization step, rad2/s2.
        """
        return self._to_linear * square, self._to_angular * square

    def slipping(self, variances: TwistVariances) -> TwistVariances:
        """Return the variances of the twist while the wheels slip.

        They are `variances` times `SLIP_FACTOR`, but at most `MAX_TWIST_VARIANCE`. The lateral
        variance grows too, because the wheels may slip in any direction.
        """
        return TwistVariances(
            min(SLIP_FACTOR * variances.linear, MAX_TWIST_VARIANCE),
            min(SLIP_FACTOR * variances.lateral, MAX_TWIST_VARIANCE),
            min(SLIP_FACTOR * variances.angular, MAX_TWIST_VARIANCE),
        )

    def with_gyro(self, variances: TwistVariances, angular: float) -> TwistVariances:
        """Return `variances`, but with the variance of the turn rate replaced by `angular`.

        `angular` is the variance of the turn rate that a gyro measured, rad2/s2.
        """
        return TwistVariances(
            variances.linear,
            variances.lateral,
            min(max(MIN_TWIST_VARIANCE, angular), MAX_TWIST_VARIANCE),
        )
