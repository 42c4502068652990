"""Converts the covariances of planar odometry to the 6x6 matrices of ROS messages.

A matrix is row major, and its axes are x, y, z, roll, pitch and yaw. Wheels do not measure z, roll
and pitch. The variances of these three axes come from the configuration, limited to a range that
RViz can draw and a filter can invert. With `odometry.covariance = "constant"`, both matrices
contain only the configured diagonals, which are not limited to this range.
"""

from __future__ import annotations

from acsard.core.config.settings import Diagonal, OdometryConfig
from acsard.core.values import PoseCovariance, TwistVariances

SMALLEST, LARGEST = 1e-6, 1e6
"""Smallest and largest variance of an axis that is not measured: m2 or rad2 for a pose, m2/s2 or
rad2/s2 for a twist."""

UNKNOWN_COVARIANCE = [LARGEST if cell % 7 == 0 else 0.0 for cell in range(36)]
"""Covariance of a twist about which nothing is known: 6x6, row major, m2/s2 and rad2/s2."""


class Covariances:
    """Builds the covariance matrices of nav_msgs/Odometry."""

    def __init__(self, odometry: OdometryConfig) -> None:
        self._constant = odometry.covariance == "constant"
        self._pose = odometry.pose_covariance_diagonal
        self._twist = odometry.twist_covariance_diagonal
        self._unmeasured = _bounded(self._pose)
        self._unmeasured_rates = _bounded(self._twist)

    def of_pose(self, p: PoseCovariance) -> list[float]:
        """Return the 6x6 covariance of the pose in the frame odom, row major.

        The units are m2, m rad and rad2. Roll, pitch and yaw are rotations about axes through the
        robot that are parallel to the axes of odom.
        """
        if self._constant:
            return _diagonal(*self._pose)
        z, roll, pitch = self._unmeasured
        # fmt: off
        return [
            p.xx,    p.xy,   0.0,  0.0,  0.0,   p.xyaw,
            p.xy,    p.yy,   0.0,  0.0,  0.0,   p.yyaw,
            0.0,     0.0,    z,    0.0,  0.0,   0.0,
            0.0,     0.0,    0.0,  roll, 0.0,   0.0,
            0.0,     0.0,    0.0,  0.0,  pitch, 0.0,
            p.xyaw,  p.yyaw, 0.0,  0.0,  0.0,   p.yawyaw,
        ]
        # fmt: on

    def of_twist(self, v: TwistVariances) -> list[float]:
        """Return the 6x6 covariance of the twist in the frame base_link, row major.

        The units are m2/s2 and rad2/s2.
        """
        if self._constant:
            return _diagonal(*self._twist)
        return _diagonal(v.linear, v.lateral, *self._unmeasured_rates, v.angular)


def _bounded(diagonal: Diagonal) -> tuple[float, float, float]:
    z, roll, pitch = (min(max(v, SMALLEST), LARGEST) for v in diagonal[2:5])
    return z, roll, pitch


def _diagonal(*variances: float) -> list[float]:
    cells = [0.0] * 36
    cells[::7] = variances
    return cells
