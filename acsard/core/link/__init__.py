"""The serial protocol of the board: lines, checksums, sample times and link state.

This package does no I/O itself.
"""
