"""Odometry, choice of the command, limits, modes and safety inputs of the robot, without I/O."""
