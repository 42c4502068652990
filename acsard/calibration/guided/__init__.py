"""`acsard calibrate` without a log: instructions, legs and measurements of a guided drive.

Each way of calibration is a table of legs (`ways.py`): what to tell the person, what to drive, what
to ask, and what the numbers measure. `runner.py` goes through such a table. `leg_driver.py` decides
the commands of one leg from messages and keys, and `robot_on_bus.py` sends them.
"""
