"""How far a step may be off what the wheels report: the odometry's noise model, and its parameters.

The travel of a side, dl or dr, has an independent error of variance k |dl| or k |dr| (Siegwart,
Nourbakhsh & Scaramuzza, Introduction to Autonomous Mobile Robots, 5.2.4). With L the track that is

    var(d) = k (|dl| + |dr|) / 4     var(dyaw) = k (|dl| + |dr|) / L2
    cov(d, dyaw) = k (|dr| - |dl|) / (2 L)

The settings say more than one k can: `distance_variance_per_metre` D and `yaw_variance_per_metre`
Y are k / 2 and 2 k / L2 if the sides are all there is. So k = min(2 D, Y L2 / 2) is theirs, what
remains of D or Y is an error of the base as a whole, and `yaw_variance_per_radian` is what skidding
adds to every turn.

The parameters' errors do not average out (Borenstein & Feng, Measurement and Correction of
Systematic Odometry Errors in Mobile Robots, 1996), so they are no noise: `columns` says how each of
them, one standard deviation off, bends a step.
"""

from __future__ import annotations

from acsard.config.settings import OdometryConfig
from acsard.drive.kinematics import Kinematics
from acsard.drive.learned_track import CONFIGURED, Track

Column = tuple[float, float, float, float]
"""m per m, m per rad, rad per m, rad per rad: what a parameter adds to distance and turn, of
distance and turn."""


SLIPPING = 100.0
"""By which every variance that the wheels tell is larger while they slip."""


class Noise:
    """Variances of one step in base_link."""

    def __init__(self, odometry: OdometryConfig, track: float) -> None:
        """`track` in m is the one that the wheels turn the robot by."""
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
        """var(d) m2, var(dyaw) rad2 and cov(d, dyaw) m rad of a step of `distance` m and `turn`.

        `turned` rad is what counts as turning of it: |turn|, or less where that is encoder noise.
        """
        left, right = abs(distance - self._half * turn), abs(distance + self._half * turn)
        path, sides = abs(distance), left + right
        return (
            self._along * path + self._to_along * sides,
            self._yaw * path + self._to_yaw * sides + self._skid * turned,
            self._to_both * (right - left),
        )


def in_use(odometry: OdometryConfig) -> Track | None:
    """The track to begin with; None where no other one is to be learned."""
    return CONFIGURED if odometry.learned_track else None


def columns(
    odometry: OdometryConfig, kinematics: Kinematics, learned: Track | None = None
) -> tuple[Column, ...]:
    """What one standard deviation of each uncertain parameter does; certain ones are left out.

    In dl = r m_l phi_l, dr = r m_r phi_r and dyaw = (dr - dl) / (m_L b), with the multipliers m.
    Where a track is to be `learned` its error has the last column, being none of the configured
    one's, and does nothing as long as that is the one in use.
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
        # Radii and track alike: every turn stays what it was.
        rows.append((odometry.distance_scale_std, 0.0, 0.0, 0.0))
    if learned is not None:
        rows.append((0.0, 0.0, 0.0, -learned.deviation))
    return tuple(rows)
