"""How a verb asks the person beside the robot: at a terminal, through a program, or nobody at all.

`prompt.py` has the protocol that `acsard calibrate` and `acsard mcu check` ask by.
"""
