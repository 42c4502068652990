"""The daemon: the process that drives one robot.

`control_loop.py` runs the steps, which compute the lines to the board. Other modules connect it to
the bus, the serial port and files, and `daemon.py` starts and ends all of them. `serial/port.py`
sends the last line of zero speeds (STOP).
"""
