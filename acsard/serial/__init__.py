"""Shell: owns the serial port; opened raw and locked, never queued on, ended with STOP."""
