"""`acsard accuracy` shows the error budget of a running robot's odometry, cause by cause."""
