"""The parameters of the calibration, and the normal equations for them that a sensor contributes.

The parameters are an array of nine numbers. Their indices are:

- LEFT, RIGHT: radius of the left and the right wheels, as ratios to the configured wheel radius.
- INVERSE_TRACK: ratio of the wheel separation to the effective track. The parameter is this inverse
  because the turns of the robot are linear in it.
- TRACK_GROWTH: fraction by which the effective track grows with each rad/s of turn rate.
- DELAY: delay of the positions behind the wheels, s.
- SENSOR_X, SENSOR_Y: the place on the robot whose positions are measured, m ahead and m to the
  left.
- BIAS_ERROR: error of the gyro's bias, rad/s.
- SCALE_ERROR: error of the gyro's scale, a fraction.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Complexes
from acsard.core.config.settings import DriveConfig

LEFT, RIGHT, INVERSE_TRACK, TRACK_GROWTH, DELAY, SENSOR_X, SENSOR_Y, BIAS_ERROR, SCALE_ERROR = (
    range(9)
)
COUNT = 9

HUBER = 2.0
"""Size of a residual, in usual sizes, above which its weight falls (Huber's weight)."""


class Base(Struct, frozen=True):
    """The configured geometry, which the parameters are relative to. Lengths are in m."""

    radius: float
    separation: float
    left: float
    """Configured multiplier of the left wheels' radius."""
    right: float
    """Configured multiplier of the right wheels' radius."""
    track: float
    """Configured multiplier of the wheel separation."""

    @classmethod
    def of(cls, drive: DriveConfig) -> Base:
        """Return the geometry of a configuration."""
        return cls(
            drive.wheel_radius, drive.wheel_separation, drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier, drive.wheel_separation_multiplier,
        )  # fmt: skip

    def start(self) -> Floats:
        """Return the parameters that agree with the configured multipliers."""
        return np.array([self.left, self.right, 1 / self.track, *[0.0] * (COUNT - TRACK_GROWTH)])

    @property
    def gain(self) -> float:
        """Wheel radius divided by wheel separation.

        If the first three parameters are 1, the robot turns by `gain` times the angle by which the
        right wheels rolled further than the left wheels.
        """
        return self.radius / self.separation


class Evidence(Struct, frozen=True):
    """The weighted normal equations of one sensor, block by block.

    With Jacobian J (derivatives of the predictions with respect to the parameters), residuals r and
    weights W: `normal` is J^T W J, and `score` is J^T W r. `fit` gives each sensor its noise.
    """

    normal: Floats
    """Left-hand sides, shape (blocks, COUNT, COUNT)."""
    score: Floats
    """Right-hand sides, shape (blocks, COUNT)."""
    squares: Floats
    """Sum of squared residuals per block."""
    counts: Floats
    """Number of independent residuals per block."""


def of_rows(
    jacobian: Floats, residual: Floats, weight: Floats, block: npt.NDArray[np.int64], blocks: int
) -> Evidence:
    """Return the evidence of rows, summed by block.

    Args:
        jacobian: derivatives of each row's prediction, shape (rows, COUNT).
        residual: measured minus predicted value of each row.
        weight: weight of each row.
        block: block number of each row.
        blocks: number of blocks.
    """
    normal = np.zeros((blocks, COUNT, COUNT))
    score = np.zeros((blocks, COUNT))
    weighted = jacobian * weight[:, None]
    np.add.at(normal, block, weighted[:, :, None] * jacobian[:, None, :])
    np.add.at(score, block, weighted * residual[:, None])
    squares = np.bincount(block, weight * residual**2, blocks).astype(np.float64)
    counts = np.bincount(block, minlength=blocks).astype(np.float64)
    return Evidence(normal, score, squares, counts)


def condition(normal: Floats) -> float:
    """Return the condition number of normal equations, scaled so that units do not matter.

    It is infinite if a parameter does not occur in the equations.
    """
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0.0):
        return np.inf
    return float(np.linalg.cond(normal / np.outer(size, size)))


def huber(residuals: Floats | Complexes, least: float) -> Floats:
    """Return Huber's weight of each residual: 1 for a usual one, and less for an outlier.

    The usual size is the standard deviation that the median suggests, and at least `least`.
    """
    size = np.abs(residuals)
    scale = max(least, 1.4826 * float(np.median(size)) if len(size) else 0.0)
    return np.asarray(np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-300)))
