"""Access to the serial port: opens it in raw mode and locked, and sends STOP before it closes."""
