"""The messages on the bus: types, table of keys, encodings, reports and signatures.

This package does no I/O.
"""
