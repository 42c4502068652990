"""Computes the variances of the twist in one report.

    var(v) = quantum + (s_R v)2 + var(d) / T2
    var(w) = quantum + (s_R v)2 + (s_L w)2 + var(dyaw) / T2

Every wheel speed is rounded to the quantum q and so has the variance q2 / 12, which the mean of a
side's two wheels halves. The s are the parameters' relative standard deviations (`noise.columns`).
T is the period over which a report is the mean. var(d) and var(dyaw) are the noise of one period
(`noise.py`), k |v| / T in all, so integrating the reports gives the noise of the pose.

If the wheels slip, all of it is multiplied by `SLIPPING`. A robot at rest is known to be at rest:
only a motion that the encoders could not have noticed remains.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.noise import SLIPPING, Column, Noise, columns, in_use
from acsard.core.values import Twist, TwistVariances

DECIMAL = 0.01
"""rad/s. A line reports a wheel's speed in two decimals."""

MOST = 1e9
"""rad2/s2. A greater variance of the turn rate carries no information."""

LEAST = 1e-8
"""m2/s2 and rad2/s2, for 0.1 mm/s. Filters treat a smaller variance as an error."""

PERIOD = 0.01
"""Period that is assumed before the first one is measured, s."""

SMOOTHED = 0.05
"""Weight of a new period in the mean. Lines that are read together seem to have no period."""


class TwistUncertainty:
    """The variances of each report's twist, by the mean period of the reports."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics, counts: int) -> None:
        """Start; `counts` are the encoders' counts per wheel turn, 0 if unknown."""
        self._track = kinematics.track
        self.use(odometry)
        self._effects = columns(odometry, kinematics, in_use(odometry))
        self._count = math.tau / counts if counts else 0.0
        # The errors of the four wheels are independent, and each side is the mean of two.
        self._to_linear = kinematics.radius**2 / 4 / 12
        self._radius = kinematics.radius
        self._turn_by(self._track)
        self._period = PERIOD

    def use(self, odometry: OdometryConfig) -> None:
        """Use these noise settings from now on."""
        self._odometry = odometry
        self._lateral = odometry.twist_covariance_diagonal[1]
        self._noise = Noise(odometry, self._track)

    def bent_by(self, parameters: tuple[Column, ...], track: float) -> None:
        """Use these columns and the track of `track` m from now on."""
        self._effects = parameters
        self._turn_by(track)
        self._noise = Noise(self._odometry, track)

    def _turn_by(self, track: float) -> None:
        self._track = track
        self._to_angular = self._radius**2 / track**2 / 12

    def of(self, twist: Twist, dt: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of a report that came `dt` s after the one before, 0 if unknown.

        `step` is the quantization step of a wheel's speed, rad/s, if the lines show it, else 0.
        """
        if dt > 0.0:
            # A late line, or one behind missing lines, does not mean a longer period.
            self._period += SMOOTHED * (min(dt, 2 * self._period) - self._period)
        period, linear, angular = self._period, twist.linear, twist.angular
        quantum = max(DECIMAL, self._count / period, step) ** 2
        along, yaw, _ = self._noise.of(linear, angular, abs(angular))
        along, yaw = along / period, yaw / period
        for to_along, by_turn, to_yaw, of_turn in self._effects:
            along += (to_along * linear + by_turn * angular) ** 2
            yaw += (to_yaw * linear + of_turn * angular) ** 2
        along += self._to_linear * quantum
        yaw += self._to_angular * quantum
        lateral = self._lateral
        # Calls of `max` would be slow here: three of them cost half as much as the rest.
        return TwistVariances(
            along if along > LEAST else LEAST,
            lateral if lateral > LEAST else LEAST,
            yaw if yaw > LEAST else LEAST,
        )

    def at_rest(self, seconds: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of a robot whose wheels reported no speed for `seconds`.

        `step` is the quantization step as in `of`.
        """
        quantum = (max(self._count, step * self._period) / seconds) ** 2
        return TwistVariances(
            max(LEAST, self._to_linear * quantum),
            LEAST,
            max(LEAST, self._to_angular * quantum),
        )

    def slipping(self, variances: TwistVariances) -> TwistVariances:
        """Return the variances for wheels that slip, which also moves the robot sideways."""
        return TwistVariances(
            min(SLIPPING * variances.linear, MOST),
            min(SLIPPING * variances.lateral, MOST),
            min(SLIPPING * variances.angular, MOST),
        )

    def with_gyro(self, variances: TwistVariances, angular: float) -> TwistVariances:
        """Return the variances with that of a gyro's turn rate, `angular` rad2/s2."""
        return TwistVariances(variances.linear, variances.lateral, min(max(LEAST, angular), MOST))
