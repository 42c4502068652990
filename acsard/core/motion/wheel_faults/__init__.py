"""Detects faulty encoders and slip, line by line, and excludes such wheels from the pose.
`verdict.py` is the entry."""
