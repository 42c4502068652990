"""The daemon: the control loop, and the bus, serial port and files around it.

`daemon.py` runs all of them, from the start of the process to its end. `serial/port.py` sends the
last zero speeds when the daemon ends.
"""
