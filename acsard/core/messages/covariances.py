"""Converts the covariances of planar odometry to the 6x6 matrices of ROS messages.

A matrix is row major, and its axes are x, y, z, roll, pitch and yaw.
"""

from __future__ import annotations

from acsard.core.values import PoseCovariance, TwistVariances

# Variance of an axis that wheels do not measure (m2, rad2, m2/s2 or rad2/s2). It is the largest
# that RViz can draw and a filter can invert.
UNMEASURED = 1e6

UNKNOWN_COVARIANCE = [UNMEASURED if cell % 7 == 0 else 0.0 for cell in range(36)]


def pose_covariance(p: PoseCovariance) -> list[float]:
    """Return the covariance of the pose in the frame odom, m2, m rad and rad2.

    The rotations are about axes through the robot that are parallel to those of odom.
    """
    u = UNMEASURED
    # fmt: off
    return [
        p.xx,    p.xy,   0.0,  0.0,  0.0,  p.xyaw,
        p.xy,    p.yy,   0.0,  0.0,  0.0,  p.yyaw,
        0.0,     0.0,    u,    0.0,  0.0,  0.0,
        0.0,     0.0,    0.0,  u,    0.0,  0.0,
        0.0,     0.0,    0.0,  0.0,  u,    0.0,
        p.xyaw,  p.yyaw, 0.0,  0.0,  0.0,  p.yawyaw,
    ]
    # fmt: on


def twist_covariance(v: TwistVariances) -> list[float]:
    """Return the covariance of the twist in the frame base_link, m2/s2 and rad2/s2."""
    cells = [0.0] * 36
    cells[::7] = (v.linear, v.lateral, UNMEASURED, UNMEASURED, UNMEASURED, v.angular)
    return cells
