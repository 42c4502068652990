"""The serial port: opened raw and locked, written without a queue, closed after a STOP."""
