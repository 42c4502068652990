"""`acsard calibrate` without a log: the tool drives the robot and asks a person for measurements.

Each method of calibration is a table of legs (`methods.py`). A leg is one drive with its
instructions, its commands and the measurements that the person makes after the drive. If a leg is
disturbed, only this leg is repeated where possible.
"""
