"""Access to the serial port: opens and locks it in raw mode, and sends STOP before closing it."""
