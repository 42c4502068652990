"""`acsard odom`: what makes the odometry of a running robot wrong, cause by cause."""
