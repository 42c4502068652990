"""The motion of the base, without I/O: kinematics, odometry, choice of command, limits, modes."""
