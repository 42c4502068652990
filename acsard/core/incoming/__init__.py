"""Pure package for input from the bus: decodes samples into commands, and queries into replies or
requests."""
