"""Prints the output of the tools, and asks questions of the person beside the robot.

`output.py` has tables and output that fits a terminal. `prompt.py` has the protocol by which
`acsard calibrate` and `acsard mcu check` ask: at a terminal, through a program, or nobody at all.
"""
