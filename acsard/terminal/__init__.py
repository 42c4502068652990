"""Prints the output of the subcommands, and asks questions of the person near the robot.

`output.py` fits tables and text to a terminal. `prompt.py` defines the interface through which
`acsard calibrate` and `acsard mcu check` ask a person: at a terminal, through another program, or
not at all.
"""
