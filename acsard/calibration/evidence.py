"""The contribution of a source of measurements to the parameters, one per block.

The nine parameters, by their index:

- LEFT, RIGHT: ratio of the left and right wheels' radius to the configured wheel radius, about 1.
- TURN: ratio of the wheel separation to the effective track, about 1. It is an inverse because
  turns are linear in it.
- RATE: growth of the track with the turn rate.
- LATE, AHEAD, ASIDE: only for positions: their delay in s and where on the robot they are measured,
  m ahead and m to the left.
- DRIFT, STRETCH: only for a gyro: the error of its bias, rad/s, and of its scale, a fraction.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Complexes
from acsard.core.config.settings import DriveConfig

LEFT, RIGHT, TURN, RATE, LATE, AHEAD, ASIDE, DRIFT, STRETCH = range(9)
COUNT = 9

HUBER = 2.0
"""Standard deviations above which a residual counts less (Huber's weight)."""


class Base(Struct, frozen=True):
    """The geometry that the parameters are relative to, m, and the configured multipliers."""

    radius: float
    separation: float
    left: float
    right: float
    track: float
    """Configured wheel separation multiplier."""

    @classmethod
    def of(cls, drive: DriveConfig) -> Base:
        """Return the configured geometry."""
        return cls(
            drive.wheel_radius, drive.wheel_separation, drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier, drive.wheel_separation_multiplier,
        )  # fmt: skip

    def start(self) -> Floats:
        """Return the parameters that are configured now."""
        return np.array([self.left, self.right, 1 / self.track, *[0.0] * (COUNT - RATE)])

    @property
    def gain(self) -> float:
        """Ratio R / L of wheel radius to wheel separation: the gain if all parameters are 1."""
        return self.radius / self.separation


class Evidence(Struct, frozen=True):
    """Normal equations per block, for unit weight."""

    normal: Floats
    """Shape (blocks, COUNT, COUNT)."""
    score: Floats
    """Shape (blocks, COUNT)."""
    squares: Floats
    """Sum of squared residuals per block."""
    counts: Floats
    """Number of independent residuals per block."""


def of_rows(
    jacobian: Floats, residual: Floats, weight: Floats, block: npt.NDArray[np.int64], blocks: int
) -> Evidence:
    """Sum rows into the blocks that they belong to.

    Args:
        jacobian: shape (rows, COUNT).
        residual: shape (rows,).
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
    """Return the condition number of normal equations, whatever the parameters' units are."""
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0.0):
        return np.inf
    return float(np.linalg.cond(normal / np.outer(size, size)))


def huber(normalised: Floats | Complexes, least: float) -> Floats:
    """Return Huber weights, between 0 and 1, for residuals.

    The usual size of a residual is `least`, or more if most residuals are larger.
    """
    size = np.abs(normalised)
    scale = max(least, 1.4826 * float(np.median(size)) if len(size) else 0.0)
    return np.asarray(np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-300)))
