"""Access to the serial port, which is opened raw and locked, and closed after a last STOP line."""
