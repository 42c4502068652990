"""Measures which faults the tests notice; `__main__.py` tells how to run it."""
