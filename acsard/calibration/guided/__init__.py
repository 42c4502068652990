"""`acsard calibrate` without a log: the tool drives the robot and asks a person for measurements.

Each method of calibration is a table of legs (`methods.py`). A leg is one drive with its
instructions, its commands and the numbers that the person reads off afterwards. `runner.py` goes
through the legs of a method. `leg_driver.py` decides the commands of one leg, and `robot_on_bus.py`
sends them and records the samples. A disturbed leg is repeated, not the whole drive. The tape
readings go to `tape_readings.py`.
"""
