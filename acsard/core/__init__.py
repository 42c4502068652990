"""The core of the daemon: time, bytes and commands go in as arguments, and decisions come out.

No module of this package does I/O or reads a clock.
"""
