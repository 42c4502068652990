"""The robot as a pure function: no module in here does any I/O."""
