"""The equipment that each method of calibration needs, in words.

This module is separate from `methods.py` so that the command line and the page can name the methods
without loading numpy.
"""

from __future__ import annotations

NEEDS: dict[str, str] = {
    "gyro": "a gyro on the key imu, and a tape measure",
    "positions": "positions on a key",
    "tape": "a tape measure and a straight line on the floor",
    "wall": "a straight wall and a tape measure",
    "umbmark": "a tape measure and marks",
}
"""Equipment by the name of the method, as `--method` takes it."""

SIMULATED = (
    "positions",
    "On the simulator there is no floor to lay a tape on: use positions with sim/pose, the true "
    "position, or gyro if [odometry] gyro is on, with its distance left empty. tape, wall and "
    "umbmark are for a real robot.",
)
"""The method to use first on the simulator, and the reason."""
