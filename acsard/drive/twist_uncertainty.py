"""How far the twist of one report may be off.

    var(v) = quantum + (s_R v)2 + var(d) / T2
    var(w) = quantum + (s_R v)2 + (s_L w)2 + var(dyaw) / T2

Every wheel speed is rounded to the line's quantum q and so has the variance q2 / 12, which the mean
of a side's two wheels halves; s are the parameters' relative standard deviations (`noise.columns`),
T is the period a report is the mean of, and var(d) and var(dyaw) are the noise of one period
(`noise.py`), k |v| / T in all. Whoever integrates reports gets the noise of the pose back.

Of wheels that slip all of it is `SLIPPING` times as much. A robot at rest is known to be: only what
an encoder could not have noticed in that time is left.
"""

from __future__ import annotations

import math

from acsard.config.settings import OdometryConfig
from acsard.drive.kinematics import Kinematics
from acsard.drive.noise import SLIPPING, Column, Noise, columns, in_use
from acsard.values import Twist, TwistVariances

DECIMAL = 0.01
"""rad/s; a line says a wheel's speed in two decimals."""

MOST = 1e9
"""rad2/s2; so uncertain a turning says nothing."""

LEAST = 1e-8
"""m2/s2 and rad2/s2: 0.1 mm/s. Filters take less for an error."""

PERIOD = 0.01
"""s, until the first period is known."""

SMOOTHED = 0.05
"""Share of a new period in the mean: lines that are read together seem to have none."""


class TwistUncertainty:
    """The variances of each report's twist; remembers the mean period."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics, counts: int) -> None:
        """`counts` of the encoders per wheel turn, 0 if unknown."""
        self._track = kinematics.track
        self.use(odometry)
        self._effects = columns(odometry, kinematics, in_use(odometry))
        self._count = math.tau / counts if counts else 0.0
        # Of four independent wheels' errors: each side is the mean of two.
        self._to_linear = kinematics.radius**2 / 4 / 12
        self._radius = kinematics.radius
        self._turn_by(self._track)
        self._period = PERIOD

    def use(self, odometry: OdometryConfig) -> None:
        """With this noise from now on."""
        self._odometry = odometry
        self._lateral = odometry.twist_covariance_diagonal[1]
        self._noise = Noise(odometry, self._track)

    def bent_by(self, parameters: tuple[Column, ...], track: float) -> None:
        """By these columns from now on, and by wheels that are `track` m apart."""
        self._effects = parameters
        self._turn_by(track)
        self._noise = Noise(self._odometry, track)

    def _turn_by(self, track: float) -> None:
        self._track = track
        self._to_angular = self._radius**2 / track**2 / 12

    def of(self, twist: Twist, dt: float, step: float = 0.0) -> TwistVariances:
        """Of a report that came `dt` s after the one before; 0 if that is unknown.

        `step` is what one count more makes of a wheel's speed, rad/s, where the lines show it.
        """
        if dt > 0.0:
            self._period += SMOOTHED * (dt - self._period)
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
        # No `max`: three calls of it cost as much as half of the rest.
        return TwistVariances(
            along if along > LEAST else LEAST,
            lateral if lateral > LEAST else LEAST,
            yaw if yaw > LEAST else LEAST,
        )

    def at_rest(self, seconds: float) -> TwistVariances:
        """Of a robot of which no wheel has reported any speed for so long."""
        quantum = (self._count / seconds) ** 2
        return TwistVariances(
            max(LEAST, self._to_linear * quantum),
            LEAST,
            max(LEAST, self._to_angular * quantum),
        )

    def slipping(self, variances: TwistVariances) -> TwistVariances:
        """Of wheels that slip: aside too, which is where a robot skids."""
        return TwistVariances(
            min(SLIPPING * variances.linear, MOST),
            min(SLIPPING * variances.lateral, MOST),
            min(SLIPPING * variances.angular, MOST),
        )

    def with_gyro(self, variances: TwistVariances, angular: float) -> TwistVariances:
        """Where a gyro tells the turn with a variance of `angular` rad2/s2."""
        return TwistVariances(variances.linear, variances.lateral, min(max(LEAST, angular), MOST))
