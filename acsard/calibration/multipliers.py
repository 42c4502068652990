"""Converts the fitted parameters and their uncertainty to the settings of `[drive]`."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from acsard.calibration.evidence import LEFT, RATE, RIGHT, TURN, Base
from acsard.calibration.fit import USUAL, Fit
from acsard.calibration.heading import Rows
from acsard.calibration.table import Floats

SEPARATION, LEFT_RADIUS, RIGHT_RADIUS = range(3)
"""Indices into `values` and `covariance`."""

TURNING = 0.05
"""Turn rate below which a row counts as straight, rad/s."""

FASTEST = 0.95
"""Fraction of all turning that is slower than the rate called the fastest."""


class Rates(Struct, frozen=True):
    """Turn rates of the robot, rad/s: the mean, weighted by angle, and the fastest."""

    mean: float
    fastest: float


class Multipliers(Struct, frozen=True):
    """Multipliers of wheel separation, left and right wheel radius, and their covariance."""

    values: Floats
    covariance: Floats

    @property
    def std(self) -> Floats:
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def own(self) -> tuple[Floats, float]:
        """Return each multiplier's own standard deviation, and the common one as a fraction.

        A tape measures the common scale, and comparing turns measures the ratios of the three
        multipliers. The odometry treats all four deviations as independent. Let d be the variance
        of the difference of both radii. Each side's own variance is d / 2. Of the variance of the
        mean radius, d / 4 therefore comes from the sides, and belongs neither to the scale nor to
        the track.
        """
        shares = self.covariance / np.outer(self.values, self.values)
        mean, track, apart = (
            float(row @ shares @ row)
            for row in np.array([[0.0, 0.5, 0.5], [1.0, -0.5, -0.5], [0.0, 1.0, -1.0]])
        )
        own = np.sqrt(np.maximum(0.0, [track - apart / 4, apart / 2, apart / 2]))
        return self.values * own, float(np.sqrt(max(0.0, mean - apart / 4)))


def configured(base: Base) -> Multipliers:
    """Return the configured multipliers.

    Their covariance is zero because their uncertainty is unknown.
    """
    return Multipliers(np.array([base.track, base.left, base.right]), np.zeros((3, 3)))


def rates(rows: Rows, by_wheels: Floats) -> Rates:
    """Return the turn rates of these rows. `by_wheels` is the turn of each row, rad."""
    turned = np.abs(by_wheels)
    rate = turned / rows.seconds
    turning = rate > TURNING
    if not turning.any():
        return Rates(0.0, 0.0)
    order = np.argsort(rate[turning])
    share = np.cumsum(turned[turning][order]) / turned[turning].sum()
    fastest = rate[turning][order][int(np.searchsorted(share, FASTEST))]
    mean = float(rate[turning] @ turned[turning] / turned[turning].sum())
    return Rates(mean, float(fastest))


def found(fit: Fit, rate: Rates) -> Multipliers:
    """Return the constant multipliers that serve best at the turn rates of the log."""
    return constant(fit.parameters, fit.covariance(), rate, fit.varies)


def constant(parameters: Floats, every: Floats, rate: Rates, varies: float) -> Multipliers:
    """Return the multipliers for given parameters and their covariance.

    The variance of the track includes how far the true track differs from this constant: at the
    slowest or fastest turn rate or, if that is more, from block to block. `varies` is the latter,
    as a fraction.
    """
    turn, slope = parameters[TURN], parameters[RATE]
    left = 1.0 - slope * rate.mean
    values = np.array([1 / (turn * left), parameters[LEFT], parameters[RIGHT]])
    jacobian = np.zeros((3, len(parameters)))
    jacobian[LEFT_RADIUS, LEFT] = jacobian[RIGHT_RADIUS, RIGHT] = 1.0
    jacobian[SEPARATION, TURN] = -values[SEPARATION] / turn
    jacobian[SEPARATION, RATE] = values[SEPARATION] * rate.mean / left
    covariance = jacobian @ every @ jacobian.T
    slopes = float(np.hypot(slope, min(USUAL[RATE], np.sqrt(every[RATE, RATE]))))
    share = max(slopes * max(rate.mean, rate.fastest - rate.mean), varies)
    covariance[SEPARATION, SEPARATION] += (values[SEPARATION] * share) ** 2
    return Multipliers(values, covariance)
