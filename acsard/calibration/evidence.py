"""What a source of measurements says of the parameters: one contribution a block.

The parameters are numbers about 1: radius of left and right over the wheel radius, wheel separation
over the effective track (its inverse makes the turn linear in all), then how the track shrinks with
the turn rate, three that only positions know: how late they are (s) and where on the robot they are
taken (m ahead, m to the left), and two of a gyro: by how much its bias is off (rad/s), and by which
share its rate is too large.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.runs import Complexes
from acsard.calibration.table import Floats

LEFT, RIGHT, TURN, RATE, LATE, AHEAD, ASIDE, DRIFT, STRETCH = range(9)
COUNT = 9

HUBER = 2.0
"""Residuals of so many standard deviations begin to count less."""


class Base(Struct, frozen=True):
    """What the parameters are measured in, and what is configured: m, and multipliers."""

    radius: float
    separation: float
    left: float
    right: float
    track: float
    """The wheel separation multiplier."""

    def start(self) -> Floats:
        """The configured parameters."""
        return np.array([self.left, self.right, 1 / self.track, *[0.0] * (COUNT - RATE)])

    @property
    def gain(self) -> float:
        """R / L of parameters that are all 1."""
        return self.radius / self.separation


class Evidence(Struct, frozen=True):
    """Per block the normal equations of unit weight; `turn` are rad by the parameters."""

    normal: Floats
    """blocks x COUNT x COUNT."""
    score: Floats
    """blocks x COUNT."""
    squares: Floats
    """Sum of squared residuals, per block."""
    counts: Floats
    """Independent residuals, per block."""


def of_rows(
    jacobian: Floats, residual: Floats, weight: Floats, block: npt.NDArray[np.int64], blocks: int
) -> Evidence:
    """From rows, each of one block."""
    normal = np.zeros((blocks, COUNT, COUNT))
    score = np.zeros((blocks, COUNT))
    weighted = jacobian * weight[:, None]
    np.add.at(normal, block, weighted[:, :, None] * jacobian[:, None, :])
    np.add.at(score, block, weighted * residual[:, None])
    squares = np.bincount(block, weight * residual**2, blocks).astype(np.float64)
    counts = np.bincount(block, minlength=blocks).astype(np.float64)
    return Evidence(normal, score, squares, counts)


def huber(normalised: Floats | Complexes, least: float) -> Floats:
    """Weights for residuals in units of which `least` are usual, or more where all are larger."""
    size = np.abs(normalised)
    scale = max(least, 1.4826 * float(np.median(size)) if len(size) else 0.0)
    return np.asarray(np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-300)))
