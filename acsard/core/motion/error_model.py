"""The error model of the odometry: noise of a step, errors of parameters, and errors of the twist.

In a step, from line to line, the sides roll dl and dr, m, with independent errors of variances k
|dl| and k |dr|, k in m (Siegwart, Nourbakhsh & Scaramuzza, Introduction to Autonomous Mobile
Robots, 5.2.4). So d = (dl + dr) / 2 and dyaw = (dr - dl) / L, with the effective track L, have
those of `Noise`. Errors of parameters do not average out, so they are no noise but `columns`
(Borenstein & Feng, Measurement and Correction of Systematic Odometry Errors in Mobile Robots,
1996).
"""

from __future__ import annotations

import math

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Twist, TwistVariances

# Error of a step for one standard deviation of a parameter: of the distance per m and per rad (m/m,
# m/rad), and of the turn per m and per rad (rad/m, rad/rad).
Column = tuple[float, float, float, float]

SLIP_FACTOR = 100.0  # on the variances of a step and of the twist while the wheels slip

SPEED_RESOLUTION = 0.01  # rad/s: a line has two decimals

MAX_TWIST_VARIANCE = 1e9  # m2/s2 and rad2/s2: "unknown"

LATERAL_VARIANCE = 1e-3  # m2/s2 sideways, which wheels do not measure, while the robot moves

MIN_TWIST_VARIANCE = 1e-8  # filters that use the published twist treat less as an error

ASSUMED_PERIOD_S = 0.01  # of the feedback lines, before it is measured

PERIOD_GAIN = 0.05  # small, because several lines may be read at the same time


class Noise:
    """The variances and the covariance of the errors of distance and turn in one step.

    var(d) = k (|dl| + |dr|) / 4
    var(dyaw) = k (|dl| + |dr|) / L^2 + yaw_variance_per_radian |turned|, for skidding
    cov(d, dyaw) = k (|dr| - |dl|) / (2 L)
    """

    def __init__(self, odometry: OdometryConfig, track: float) -> None:
        # If the sides were the only cause of errors, D = `distance_variance_per_metre` would be
        # k / 2, and Y = `yaw_variance_per_metre` 2 k / L^2. So k = min(2 D, Y L^2 / 2), and the
        # rest of D or Y is an error of the robot as a whole.
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
        """Return var(d), m2, var(dyaw), rad2, and cov(d, dyaw), m rad, for a step.

        `turned` is the part of |turn| that is a real turn and not encoder noise, rad.
        """
        left, right = abs(distance - self._half * turn), abs(distance + self._half * turn)
        path, sides = abs(distance), left + right
        return (
            self._along * path + self._to_along * sides,
            self._yaw * path + self._to_yaw * sides + self._skid * turned,
            self._to_both * (right - left),
        )


class ErrorModel:
    """The noise of a step, and the effects of parameter errors on it."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics) -> None:
        self.radius = kinematics.radius  # mean of the wheels, m
        self.settings = odometry
        self.track = kinematics.track
        self.columns = columns(odometry, kinematics)
        self.noise = Noise(odometry, self.track)

    def use(self, odometry: OdometryConfig) -> None:
        """Use other noise settings, and keep the parameter errors."""
        self.settings = odometry
        self.noise = Noise(odometry, self.track)


def columns(odometry: OdometryConfig, kinematics: Kinematics) -> tuple[Column, ...]:
    """Return a `Column` for each uncertain parameter, those with a standard deviation.

    The equations of a step are, with r `wheel_radius`, b `wheel_separation` and rolled angles phi,

        dl = r m_l phi_l,   dr = r m_r phi_r,   dyaw = (dr - dl) / (m_L b)

    The parameters are m_l, m_r, m_L, m_r / m_l, and in one column the scale of all lengths and the
    fraction that slip loses.
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
        # One radius is larger by half of the ratio's error, the other smaller.
        share = odometry.wheel_radius_ratio_std
        rows.append((0.0, share * track / 4, share / track, 0.0))
    # Scale and permanent slip change distances alone: radii and track scale alike.
    if scale := math.hypot(odometry.distance_scale_std, odometry.wheel_slip_std):
        rows.append((scale, 0.0, 0.0, 0.0))
    return tuple(rows)


class TwistUncertainty:
    """The variances of the twist (v, w) that a line reports.

        var(v) = a_v q^2 / 12 + var(d) / T^2 + sum of (c_1 v + c_2 w)^2
        var(w) = a_w q^2 / 12 + var(dyaw) / T^2 + sum of (c_3 v + c_4 w)^2

    q is the quantization step of the speeds, with two wheels on each side in a_v and a_w, and T the
    mean period. With var(d) and var(dyaw), the noise of one period, a pose that is integrated from
    twists is as uncertain as the odometry's. The sums are over `columns`.
    """

    def __init__(self, model: ErrorModel, counts: int) -> None:
        self._model = model
        self._count = math.tau / counts if counts else 0.0
        # Four independent errors; each side is the mean of two wheels.
        self._to_linear = model.radius**2 / 4 / 12
        self._period = ASSUMED_PERIOD_S
        self._to_angular = model.radius**2 / model.track**2 / 12

    def of(self, twist: Twist, dt: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of a line's twist; `dt` and the speeds' step may be 0, unknown."""
        if dt > 0.0:
            # A late line, or one after lost lines, does not mean a longer period.
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
        """Return the variances at rest: of a motion that no encoder shows in `seconds`."""
        linear, angular = self.rounding((max(self._count, step * self._period) / seconds) ** 2)
        return TwistVariances(
            max(MIN_TWIST_VARIANCE, linear),
            MIN_TWIST_VARIANCE,
            max(MIN_TWIST_VARIANCE, angular),
        )

    def rounding(self, square: float) -> tuple[float, float]:
        """Return the variances, m2/s2 and rad2/s2, by a squared quantization step, rad2/s2."""
        return self._to_linear * square, self._to_angular * square

    def slipping(self, variances: TwistVariances) -> TwistVariances:
        return TwistVariances(
            min(SLIP_FACTOR * variances.linear, MAX_TWIST_VARIANCE),
            min(SLIP_FACTOR * variances.lateral, MAX_TWIST_VARIANCE),
            min(SLIP_FACTOR * variances.angular, MAX_TWIST_VARIANCE),
        )

    def with_gyro(self, variances: TwistVariances, angular: float) -> TwistVariances:
        """Return the variances with the gyro's variance of the turn rate, rad2/s2."""
        return TwistVariances(
            variances.linear,
            variances.lateral,
            min(max(MIN_TWIST_VARIANCE, angular), MAX_TWIST_VARIANCE),
        )
