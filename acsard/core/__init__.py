"""The robot as a pure function. No module of this package does any I/O."""
