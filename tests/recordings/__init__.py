"""Recorded drives, which `tests/test_recordings.py` replays.

Each file is the output of `acsard run --record`. `python -m tests.recordings` wrote the present
ones. You can also store the unchanged recording of a robot that behaved oddly.
"""
