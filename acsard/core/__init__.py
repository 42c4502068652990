"""The robot as a pure function. No module of this package does I/O or reads a clock."""
