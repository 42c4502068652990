"""The shells: clock, period, serial port, Zenoh bus, logs, the loop that joins them."""
