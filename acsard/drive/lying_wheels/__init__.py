"""Wheels that lie or slip, found line by line and left out of the pose: start at `verdict.py`."""
