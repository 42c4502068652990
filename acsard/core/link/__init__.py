"""Handles the serial protocol of the board: lines, checksums, sample times and the link state.

The package does no input or output.
"""
