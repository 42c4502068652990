"""Recorded drives, replayed by `tests/test_recordings.py`: each a file of `acsard run --record`.

A file of a robot that did something odd may lie here as it is. Those that are here were made by

    python -m tests.recordings
"""
