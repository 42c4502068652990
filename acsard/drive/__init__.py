"""The base's behaviour, pure: kinematics, odometry, command choice, limits and modes."""
