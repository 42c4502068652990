"""`acsard calibrate`: recorded drives -> wheel radii and effective track, and how sure they are."""
