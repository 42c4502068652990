"""Access to the serial port: opens and locks it in raw mode, and sends STOP before closing it.

STOP is the line that commands zero speed for all wheels.
"""
