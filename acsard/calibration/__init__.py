"""`acsard calibrate`: geometry and noise from a recorded drive, or from a guided one."""
