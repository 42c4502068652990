"""Kinematics and odometry worked by hand. A comment beside each number shows the arithmetic.

Default robot: wheel radius r = 0.05 m, track L = 0.30 m. All units are SI.
"""

from __future__ import annotations

from math import pi

from acsard.core.config.settings import DriveConfig

DEFAULT = DriveConfig()

CALIBRATED = DriveConfig(
    wheel_separation_multiplier=1.5,
    left_wheel_radius_multiplier=0.8,
    right_wheel_radius_multiplier=1.25,
)
"""L = 0.30 x 1.5 = 0.45 m, r_l = 0.05 x 0.8 = 0.04 m, r_r = 0.05 x 1.25 = 0.0625 m."""

WHEELS_OF_TWIST = [
    # robot, (v, w), left, right: left = (v - w L / 2) / r_l, right = (v + w L / 2) / r_r
    (DEFAULT, (0.0, 0.0), 0.0, 0.0),
    (DEFAULT, (0.5, 0.0), 10.0, 10.0),  # 0.5 / 0.05
    (DEFAULT, (-0.5, 0.0), -10.0, -10.0),
    (DEFAULT, (0.0, 2.0), -6.0, 6.0),  # 2 x 0.15 = 0.3; 0.3 / 0.05
    (DEFAULT, (0.0, -2.0), 6.0, -6.0),
    (DEFAULT, (0.3, 1.0), 3.0, 9.0),  # 0.3 -+ 0.15 = 0.15, 0.45
    (DEFAULT, (0.15, -1.0), 6.0, 0.0),  # 0.15 +- 0.15 = 0.30, 0: turns about its right side
    (DEFAULT, (-0.2, 0.5), -5.5, -2.5),  # -0.2 -+ 0.075 = -0.275, -0.125
    (CALIBRATED, (0.5, 0.0), 12.5, 8.0),  # 0.5 / 0.04, 0.5 / 0.0625
    (CALIBRATED, (0.5, 2.0), 1.25, 15.2),  # 0.5 -+ 0.45 = 0.05, 0.95; / 0.04, / 0.0625
    (CALIBRATED, (0.0, 1.0), -5.625, 3.6),  # -+ 0.225; / 0.04, / 0.0625
]

TWIST_OF_WHEELS = [
    # robot, (front_right, front_left, rear_left, rear_right), (v, w)
    # left = (1 + 3) / 2 = 2, right = (4 + 8) / 2 = 6: v = 0.05 x 8 / 2, w = 0.05 x 4 / 0.30
    (DEFAULT, (4.0, 1.0, 3.0, 8.0), (0.2, 2 / 3)),
    # the seed line: left = (-8.75 + 15) / 2 = 3.125, right = (12.5 - 10.25) / 2 = 1.125:
    # v = 0.05 x 4.25 / 2, w = 0.05 x -2 / 0.30
    (DEFAULT, (12.5, -8.75, 15.0, -10.25), (0.10625, -1 / 3)),
    # one wheel alone: right = 8 / 2 = 4: v = 0.05 x 4 / 2, w = 0.05 x 4 / 0.30
    (DEFAULT, (8.0, 0.0, 0.0, 0.0), (0.1, 2 / 3)),
    (DEFAULT, (0.0, 8.0, 0.0, 0.0), (0.1, -2 / 3)),
    (DEFAULT, (0.0, 0.0, 8.0, 0.0), (0.1, -2 / 3)),
    (DEFAULT, (0.0, 0.0, 0.0, 8.0), (0.1, 2 / 3)),
    # left = 10 x 0.04 = 0.4 m/s, right = 8 x 0.0625 = 0.5 m/s: v = 0.9 / 2, w = 0.1 / 0.45
    (CALIBRATED, (8.0, 10.0, 10.0, 8.0), (0.45, 2 / 9)),
]

PATHS = [
    # left, right (rad/s), seconds, pose (x, y, yaw) from (0, 0, 0)
    # straight: v = 0.5 m/s
    ("straight", 10.0, 10.0, 2.0, (1.0, 0.0, 0.0)),
    ("backward", -10.0, -10.0, 2.0, (-1.0, 0.0, 0.0)),
    # v = 0.05 x 12 / 2 = 0.3, w = 0.05 x 3 / 0.30 = 0.5: a circle of 0.3 / 0.5 = 0.6 m; a quarter
    # of it takes (pi / 2) / 0.5 = pi s and ends one radius ahead and one to the left
    ("quarter circle left", 4.5, 7.5, pi, (0.6, 0.6, pi / 2)),
    ("quarter circle right", 7.5, 4.5, pi, (0.6, -0.6, -pi / 2)),
    # v = -0.3, w = +0.5: the same circle, one radius behind and one to the right
    ("quarter circle backward", -7.5, -4.5, pi, (-0.6, -0.6, pi / 2)),
    # three quarters: yaw = 3 pi / 2, which is -pi / 2
    ("three quarters left", 4.5, 7.5, 3 * pi, (-0.6, 0.6, -pi / 2)),
    # a whole circle
    ("full circle", 4.5, 7.5, 4 * pi, (0.0, 0.0, 0.0)),
    # in place: w = 0.05 x 6 / 0.30 = 1; 4 rad are 4 - 2 pi
    ("spin left", -3.0, 3.0, 1.0, (0.0, 0.0, 1.0)),
    ("spin right", 3.0, -3.0, 1.0, (0.0, 0.0, -1.0)),
    ("spin past pi", -3.0, 3.0, 4.0, (0.0, 0.0, 4.0 - 2 * pi)),
    # about the left side: left stands, v = 0.05 x 6 / 2 = 0.15, w = 0.05 x 6 / 0.30 = 1, radius
    # 0.15; after pi s it has turned round and stands two radii to the left
    ("half circle about the left wheels", 0.0, 6.0, pi, (0.0, 0.3, pi)),
]

SEED_STEP = (4.5, 7.5, 0.1)
"""left, right (rad/s), dt (s) of one step of the seed's equations from (0, 0, 0):

(4) d_left = 0.05 x 4.5 x 0.1 = 0.0225    (5) d_right = 0.05 x 7.5 x 0.1 = 0.0375
(6) d = 0.06 / 2 = 0.03                   (7) dyaw = 0.015 / 0.30 = 0.05
(8) x = 0.03 cos 0 = 0.03                 (9) y = 0.03 sin 0 = 0
(10) yaw = 0.05                           (11) v = 0.03 / 0.1 = 0.3, w = 0.05 / 0.1 = 0.5
"""

SEED_STEP_ARC = (0.0299875016, 0.0007498438, 0.05)
"""(8) to (10) along the arc: R = 0.03 / 0.05 = 0.6; R sin 0.05 = 0.6 x 0.0499791693,
R (1 - cos 0.05) = 0.6 x 0.0012497396."""

SEED_STEP_TWIST = (0.3, 0.5)
"""(11)"""
