"""`acsard accuracy`: the odometry error of a running robot, cause by cause."""
