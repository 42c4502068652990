"""Access to the serial port: opens and locks it raw, and sends STOP (zeros) before closing it."""
