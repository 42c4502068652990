"""The error model of the odometry: errors of one step, of the parameters and of a report's twist.

The travel of a side, dl or dr, has an independent error of variance k |dl| or k |dr| (Siegwart,
Nourbakhsh & Scaramuzza, Introduction to Autonomous Mobile Robots, 5.2.4). With the track L that
gives

    var(d) = k (|dl| + |dr|) / 4     var(dyaw) = k (|dl| + |dr|) / L2
    cov(d, dyaw) = k (|dr| - |dl|) / (2 L)

The settings express more than one k can. If only the sides erred, `distance_variance_per_metre` D
would be k / 2 and `yaw_variance_per_metre` Y would be 2 k / L2. So k = min(2 D, Y L2 / 2) is the
noise of the sides, and the rest of D or Y is an error of the base as a whole. The skid adds
`yaw_variance_per_radian` to every turn.

The errors of the parameters do not average out (Borenstein & Feng, Measurement and Correction of
Systematic Odometry Errors in Mobile Robots, 1996), so they are not noise. `columns` gives the
effect on a step of each parameter that is off by one standard deviation.

`ErrorModel` holds both for the settings and the track in use. The pose (`uncertainty.py`) and the
twist of each report (`TwistUncertainty`) share it.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.learned_track import CONFIGURED, Track
from acsard.core.values import Twist, TwistVariances

Column = tuple[float, float, float, float]
"""The effect of a parameter's error on a step: m per m, m per rad, rad per m and rad per rad. The
first two add to the distance and the last two to the turn, for each m and rad of the step."""

SLIPPING = 100.0
"""Factor on every variance of the wheels while they slip."""

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


class Noise:
    """The variances of one step in base_link."""

    def __init__(self, odometry: OdometryConfig, track: float) -> None:
        """Compute the model; `track` is the one by which the wheels turn the robot, m."""
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
        """Return var(d) m2, var(dyaw) rad2 and cov(d, dyaw) m rad of a step, in m and rad.

        `turned` rad is the part of the step that counts as turning: |turn|, or less if a part is
        encoder noise.
        """
        left, right = abs(distance - self._half * turn), abs(distance + self._half * turn)
        path, sides = abs(distance), left + right
        return (
            self._along * path + self._to_along * sides,
            self._yaw * path + self._to_yaw * sides + self._skid * turned,
            self._to_both * (right - left),
        )


class ErrorModel:
    """The noise and the parameters' effects on a step, for the settings and the track in use."""

    def __init__(self, odometry: OdometryConfig, kinematics: Kinematics) -> None:
        """Start with the configured track."""
        self._declared, self._kinematics = odometry, kinematics
        self.radius = kinematics.radius
        """Mean radius of the wheels, m."""
        self.settings = odometry
        self.turn_by(CONFIGURED if odometry.learned_track else None)

    def use(self, odometry: OdometryConfig) -> None:
        """Use this noise from now on. The parameters and their uncertainty stay."""
        self.settings = odometry
        self.noise = Noise(odometry, self.track)

    def turn_by(self, learned: Track | None) -> None:
        """Use this effective track from now on; None if none is learned at all."""
        self.track = self._kinematics.track * (learned or CONFIGURED).share
        """Track by which the wheels turn the robot, m."""
        self.columns = columns(self._declared, self._kinematics, learned)
        self.noise = Noise(self.settings, self.track)


def columns(
    odometry: OdometryConfig, kinematics: Kinematics, learned: Track | None = None
) -> tuple[Column, ...]:
    """Return the effect of one standard deviation of each uncertain parameter; omit certain ones.

    The parameters are those of dl = r m_l phi_l, dr = r m_r phi_r and dyaw = (dr - dl) / (m_L b),
    with the multipliers m. With a `learned` track the last column is its error, independent of the
    configured track's. It is zero while the configured track is in use.
    """
    used = learned or CONFIGURED
    track = kinematics.track * used.share
    left, right, separation = kinematics.multipliers
    rows = []
    if odometry.left_wheel_radius_multiplier_std:
        share = odometry.left_wheel_radius_multiplier_std / left
        rows.append((share / 2, -share * track / 4, -share / track, share / 2))
    if odometry.right_wheel_radius_multiplier_std:
        share = odometry.right_wheel_radius_multiplier_std / right
        rows.append((share / 2, share * track / 4, share / track, share / 2))
    if odometry.wheel_separation_multiplier_std:
        share = 0.0 if used.deviation else odometry.wheel_separation_multiplier_std / separation
        rows.append((0.0, 0.0, 0.0, -share))
    if odometry.distance_scale_std:
        # This scales radii and track alike, so turns do not change.
        rows.append((odometry.distance_scale_std, 0.0, 0.0, 0.0))
    if learned is not None:
        rows.append((0.0, 0.0, 0.0, -learned.deviation))
    return tuple(rows)


class TwistUncertainty:
    """The variances of each report's twist, by the mean period of the reports.

        var(v) = quantum + (s_R v)2 + var(d) / T2
        var(w) = quantum + (s_R v)2 + (s_L w)2 + var(dyaw) / T2

    Every wheel speed is rounded to the quantum q and so has the variance q2 / 12, which the mean of
    a side's two wheels halves. The s are the parameters' relative standard deviations (`columns`).
    T is the period over which a report is the mean. var(d) and var(dyaw) are the noise of one
    period, k |v| / T in all, so integrating the reports gives the noise of the pose.

    If the wheels slip, all of it is multiplied by `SLIPPING`. A robot at rest is known to be at
    rest: only a motion that the encoders could not have noticed remains.
    """

    def __init__(self, model: ErrorModel, counts: int) -> None:
        """Start; `counts` are the encoders' counts per wheel turn, 0 if unknown."""
        self._model = model
        self._count = math.tau / counts if counts else 0.0
        # The errors of the four wheels are independent, and each side is the mean of two.
        self._to_linear = model.radius**2 / 4 / 12
        self._period = PERIOD
        self.bend()

    def bend(self) -> None:
        """Use the model's track from now on."""
        self._to_angular = self._model.radius**2 / self._model.track**2 / 12

    def of(self, twist: Twist, dt: float, step: float = 0.0) -> TwistVariances:
        """Return the variances of a report that came `dt` s after the one before, 0 if unknown.

        `step` is the quantization step of a wheel's speed, rad/s, if the lines show it, else 0.
        """
        if dt > 0.0:
            # A late line, or one behind missing lines, does not mean a longer period.
            self._period += SMOOTHED * (min(dt, 2 * self._period) - self._period)
        model, period, linear, angular = self._model, self._period, twist.linear, twist.angular
        quantum = max(DECIMAL, self._count / period, step) ** 2
        along, yaw, _ = model.noise.of(linear, angular, abs(angular))
        along, yaw = along / period, yaw / period
        for to_along, by_turn, to_yaw, of_turn in model.columns:
            along += (to_along * linear + by_turn * angular) ** 2
            yaw += (to_yaw * linear + of_turn * angular) ** 2
        along += self._to_linear * quantum
        yaw += self._to_angular * quantum
        lateral = model.settings.twist_covariance_diagonal[1]
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
