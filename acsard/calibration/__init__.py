"""`acsard calibrate`: computes wheel radii, effective track and their uncertainty from drives."""
