"""What each way of calibrating by a guided drive needs, in words; the ways are in `ways.py`."""

from __future__ import annotations

NEEDS: dict[str, str] = {
    "gyro": "a gyro on the key imu, and a tape measure",
    "positions": "positions on a key",
    "tape": "a tape measure and a straight line on the floor",
    "wall": "a straight wall and a tape measure",
    "umbmark": "a tape measure and marks",
}
