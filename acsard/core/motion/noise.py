"""The noise model of the odometry: errors of one step, and of the parameters.

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
"""

from __future__ import annotations

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.learned_track import CONFIGURED, Track

Column = tuple[float, float, float, float]
"""The effect of a parameter's error on a step: m per m, m per rad, rad per m and rad per rad. The
first two add to the distance and the last two to the turn, for each m and rad of the step."""


SLIPPING = 100.0
"""Factor on every variance of the wheels while they slip."""


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


def in_use(odometry: OdometryConfig) -> Track | None:
    """Return the initial track, None if the track is not to be learned."""
    return CONFIGURED if odometry.learned_track else None


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
