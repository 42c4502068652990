"""Recorded drives that `tests/test_recordings.py` replays, each a file of `acsard run --record`.

The file of a robot that behaved oddly may be stored here unchanged. `python -m tests.recordings`
made those that are here now.
"""
