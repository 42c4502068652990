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
        odometry takes them for independent, and the two are. A side's own is such that the
        difference of two independent ones is that of the radii.
        """
        shares = self.covariance / np.outer(self.values, self.values)
        scale, track, radii = (
            float(np.sqrt(max(0.0, row @ shares @ row)))
            for row in np.array([[0.0, 0.5, 0.5], [1.0, -0.5, -0.5], [0.0, 1.0, -1.0]])
        )
        return self.values * np.array([track, radii, radii]) / [1.0, np.sqrt(2), np.sqrt(2)], scale


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
