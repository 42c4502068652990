"""Decides how the robot moves: odometry, choice of the command, limits, modes. Does no I/O."""
