"""The serial protocol of the board: lines, checksums, sample times and link state. Does no I/O."""
