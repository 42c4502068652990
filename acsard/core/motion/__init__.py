"""Pure package for the motion of the base: kinematics, odometry, choice of command, limits and
modes."""
