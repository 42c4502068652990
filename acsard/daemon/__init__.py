"""The daemon: the process that drives one robot.

`control_loop.py` runs the control steps, which compute the lines to the board. The other modules
connect the control loop to the Zenoh bus, to the serial port and to files. `daemon.py` starts and
ends all of them. When the daemon ends, `serial/port.py` sends the last line of zero speeds (STOP).
"""
