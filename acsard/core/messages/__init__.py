"""Defines the messages on the bus: types, the table of keys, encodings, reports and signatures.

The package does no input or output.
"""
