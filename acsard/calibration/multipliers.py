"""The parameters as the settings of `[drive]`, and how sure they are."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from acsard.calibration.evidence import LEFT, RATE, RIGHT, TURN, Base
from acsard.calibration.fit import USUAL, Fit
from acsard.calibration.heading import Rows
from acsard.calibration.table import Floats

SEPARATION, LEFT_RADIUS, RIGHT_RADIUS = range(3)
"""Indices of `values` and `covariance`."""

TURNING = 0.05
"""rad/s; a row that turns less is straight."""

FASTEST = 0.95
"""So much of all that was turned was turned slower than what is called the fastest."""


class Rates(Struct, frozen=True):
    """At which rates the robot turned, rad/s: the mean, each rad weighing the same, and the
    fastest."""

    mean: float
    fastest: float


class Multipliers(Struct, frozen=True):
    """Of wheel separation, left and right wheel radius, and their covariance."""

    values: Floats
    covariance: Floats

    @property
    def std(self) -> Floats:
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def own(self) -> tuple[Floats, float]:
        """The standard deviations apart from what all three have in common, and of that: a share.

        A tape says how large everything is, whatever compares turns says how the three relate. The
        odometry takes all four for independent. A side's own has half the variance d of the radii's
        difference, so that of the mean radius d / 4 is the sides' and no scale's, nor the track's.
        """
        shares = self.covariance / np.outer(self.values, self.values)
        mean, track, apart = (
            float(row @ shares @ row)
            for row in np.array([[0.0, 0.5, 0.5], [1.0, -0.5, -0.5], [0.0, 1.0, -1.0]])
        )
        own = np.sqrt(np.maximum(0.0, [track - apart / 4, apart / 2, apart / 2]))
        return self.values * own, float(np.sqrt(max(0.0, mean - apart / 4)))


def configured(base: Base) -> Multipliers:
    """As they are now, of which nobody knows how sure they are."""
    return Multipliers(np.array([base.track, base.left, base.right]), np.zeros((3, 3)))


def rates(rows: Rows, by_wheels: Floats) -> Rates:
    """Of these rows; `by_wheels` is how far each turned, rad."""
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
    """The constants that serve best at the rates that were driven.

    The variance of the track has how far it is from this constant at the slowest or fastest of
    them, or from block to block, whichever is more.
    """
    turn, slope = fit.parameters[TURN], fit.parameters[RATE]
    left = 1.0 - slope * rate.mean
    values = np.array([1 / (turn * left), fit.parameters[LEFT], fit.parameters[RIGHT]])
    jacobian = np.zeros((3, len(fit.parameters)))
    jacobian[LEFT_RADIUS, LEFT] = jacobian[RIGHT_RADIUS, RIGHT] = 1.0
    jacobian[SEPARATION, TURN] = -values[SEPARATION] / turn
    jacobian[SEPARATION, RATE] = values[SEPARATION] * rate.mean / left
    every = fit.covariance()
    covariance = jacobian @ every @ jacobian.T
    slopes = float(np.hypot(slope, min(USUAL[RATE], np.sqrt(every[RATE, RATE]))))
    share = max(slopes * max(rate.mean, rate.fastest - rate.mean), fit.varies)
    covariance[SEPARATION, SEPARATION] += (values[SEPARATION] * share) ** 2
    return Multipliers(values, covariance)
