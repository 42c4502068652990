"""The equipment that each way of calibration in `ways.py` needs, in words.

It stands apart so that the command line and the page can name the ways without loading numpy.
"""

from __future__ import annotations

NEEDS: dict[str, str] = {
    "gyro": "a gyro on the key imu, and a tape measure",
    "positions": "positions on a key",
    "tape": "a tape measure and a straight line on the floor",
    "wall": "a straight wall and a tape measure",
    "umbmark": "a tape measure and marks",
}

SIMULATED = (
    "positions",
    "On the simulator there is no floor to lay a tape on: use positions with sim/pose, the true "
    "position, or gyro if [odometry] gyro is on, with its distance left empty. tape, wall and "
    "umbmark are for a real robot.",
)
"""The way to begin with on the simulator, and why."""
