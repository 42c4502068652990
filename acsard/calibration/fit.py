"""Fits the parameters of the calibration to the measurements of all sensors, by Gauss-Newton.

Each sensor contributes its evidence to the normal equations, separately for each block (a few
seconds of driving). The standard deviations come from a jackknife over the blocks (Quenouille and
Tukey), so they are right even if the errors within a block are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Complexes, Mask
from acsard.core.config.settings import DriveConfig


class Parameter(IntEnum):
    """Indices of the fitted parameters in an array of `PARAMETER_COUNT` numbers."""

    LEFT = 0  # radius of the left wheels / configured wheel radius
    RIGHT = 1  # radius of the right wheels / configured wheel radius
    INVERSE_TRACK = 2  # configured wheel separation / effective track
    TRACK_GROWTH = 3  # fraction by which the effective track grows for each rad/s of turn rate
    DELAY = 4  # of the positions' recorded times after those of the wheels, s
    SENSOR_X = 5  # position sensor ahead of the robot's middle, m
    SENSOR_Y = 6  # position sensor to the left of the robot's middle, m
    BIAS_ERROR = 7  # gyro bias that the measurement at rest leaves, rad/s
    SCALE_ERROR = 8  # of the gyro, relative: with 0.01, it shows turns 1 % too large


PARAMETER_COUNT = len(Parameter)
RADII = [Parameter.LEFT, Parameter.RIGHT]
# Radii, inverse track and track growth.
WHEEL_PARAMETERS = list(Parameter)[: Parameter.DELAY]

HUBER_LIMIT = 2.0  # standard deviations of a residual, above which its weight is less than 1


class Base(Struct, frozen=True):
    """The configured geometry, to which the fitted parameters are relative. Lengths are in m."""

    radius: float
    separation: float
    left: float  # configured multiplier of the left wheels' radius
    right: float  # configured multiplier of the right wheels' radius
    track: float  # configured multiplier of the wheel separation

    @classmethod
    def of(cls, drive: DriveConfig) -> Base:
        return cls(
            drive.wheel_radius, drive.wheel_separation, drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier, drive.wheel_separation_multiplier,
        )  # fmt: skip

    def start(self) -> Floats:
        """Return the parameters that describe the configured robot; those of sensors are 0."""
        parameters = np.zeros(PARAMETER_COUNT)
        parameters[: Parameter.TRACK_GROWTH] = self.left, self.right, 1 / self.track
        return parameters

    def configured(self, parameters: Floats) -> Floats:
        """Return `parameters` with the configured geometry, and with a track growth of 0."""
        return np.concatenate((self.start()[: Parameter.DELAY], parameters[Parameter.DELAY :]))

    @property
    def radius_per_separation(self) -> float:
        """Turn of the robot, rad, if the right wheels roll 1 rad further than the left ones."""
        return self.radius / self.separation


class Evidence(Struct, frozen=True):
    """The contribution of one sensor to the normal equations of the fit, block by block.

    J is the Jacobian of the predictions, r the residuals and W their weights. `fit()` divides J^T W
    J and J^T W r by the noise variance of the sensor.
    """

    normal: Floats  # left-hand sides J^T W J, shape (blocks, PARAMETER_COUNT, PARAMETER_COUNT)
    score: Floats  # right-hand sides J^T W r, shape (blocks, PARAMETER_COUNT)
    squares: Floats  # sum of weighted squared residuals per block
    counts: Floats  # number of independent residuals per block


def evidence_from_measurements(
    jacobian: Floats, residual: Floats, weight: Floats, block: npt.NDArray[np.int64], blocks: int
) -> Evidence:
    """Return the evidence of one sensor from its measurements, summed by block.

    The shape of `jacobian` is (measurements, PARAMETER_COUNT).
    """
    normal = np.zeros((blocks, PARAMETER_COUNT, PARAMETER_COUNT))
    score = np.zeros((blocks, PARAMETER_COUNT))
    weighted = jacobian * weight[:, None]
    np.add.at(normal, block, weighted[:, :, None] * jacobian[:, None, :])
    np.add.at(score, block, weighted * residual[:, None])
    squares = np.bincount(block, weight * residual**2, blocks).astype(np.float64)
    counts = np.bincount(block, minlength=blocks).astype(np.float64)
    return Evidence(normal, score, squares, counts)


def condition(normal: Floats) -> float:
    """Return the condition number of `normal` after scaling its diagonal to 1.

    It is infinite if a parameter does not influence the predictions.
    """
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0.0):
        return np.inf
    return float(np.linalg.cond(normal / np.outer(size, size)))


def huber(residuals: Floats | Complexes, least: float) -> Floats:
    """Return Huber's weight of each residual, by which outliers have less influence on a fit.

    The standard deviation is 1.4826 times the median absolute residual, but at least `least`.
    """
    size = np.abs(residuals)
    scale = max(least, 1.4826 * float(np.median(size)) if len(size) else 0.0)
    return np.asarray(np.minimum(1.0, HUBER_LIMIT * scale / np.maximum(size, 1e-300)))


Source = Callable[[Floats], Evidence]  # the evidence of a sensor, for given parameters

MAX_STEPS = 30
# The fit ends after a step below `SMALL`, and has converged if its last step is below `SETTLED`. A
# step is the largest change of a wheel parameter: 0.01 is 1 % of a radius.
SMALL, SETTLED = 1e-5, 0.02

# Prior standard deviations of parameters that some logs do not determine.
PRIOR_STD = {
    Parameter.TRACK_GROWTH: 0.06,
    Parameter.DELAY: 1.0,
    Parameter.SENSOR_X: 0.5,
    Parameter.SENSOR_Y: 0.5,
}

GYRO_SCALE_STD = 0.005  # relative, of a MEMS gyro; only positions can show its scale

CONSTRAINT_WEIGHT = 1e9  # of a `Held` in the normal equations, large enough to enforce it

# Constraint: weights of the parameters, shape (PARAMETER_COUNT,), and the value of their sum.
Held = tuple[Floats, float]

MIN_PAIR_BLOCKS = 16  # for a jackknife that also leaves out pairs of neighboring blocks

MIN_BLOCKS = 5  # in a log; and least runs for a jackknife that leaves out whole runs


def student_factor(free: Floats | float) -> Floats:
    """Return the variance of Student's t with max(`free`, 3) degrees of freedom.

    It is the factor by which to increase a variance that was estimated from few values.
    """
    free = np.maximum(3.0, free)
    return np.asarray(free / (free - 2))


class Fit(Struct, frozen=True):
    """The result of a fit: the fitted parameters, and the normal equations at these parameters."""

    parameters: Floats
    normal: Floats  # left-hand sides, shape (blocks, PARAMETER_COUNT, PARAMETER_COUNT)
    score: Floats  # right-hand sides, shape (blocks, PARAMETER_COUNT)
    # Added to the left-hand side by constraints and priors, shape (PARAMETER_COUNT,
    # PARAMETER_COUNT).
    prior_normal: Floats
    active: tuple[Parameter, ...]  # indices of the parameters that were fitted
    converged: bool
    prior_std: Mapping[Parameter, float]  # prior standard deviation of each parameter that has one

    def without(self, blocks: Mask) -> Floats:
        """Return approximate parameters of a fit without the blocks in the mask."""
        rest = self.normal[~blocks].sum(axis=0) + self.prior_normal
        parameters = self.parameters.copy()
        parameters[list(self.active)] -= _solved(rest, self.score[blocks].sum(axis=0), self.active)
        return parameters

    def marginal(self) -> Floats:
        """Return the matrix of the normal equations, reduced to the wheel parameters.

        Its condition number shows how well the log separates the radii from the track. The unknowns
        are left radius, right radius and inverse track; without positions, the difference of the
        radii and the inverse track.
        """
        total = self.normal.sum(axis=0) + self.prior_normal
        rest = [index for index in self.active if index > Parameter.INVERSE_TRACK]
        inner, cross = total[np.ix_(rest, rest)], total[:3, rest]
        three = np.asarray(total[:3, :3] - cross @ np.linalg.solve(inner, cross.T))
        sized = Parameter.DELAY in self.active
        free = np.eye(3) if sized else np.array([[-0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(free @ three @ free.T)

    def covariance(self, runs: Sequence[int] = ()) -> Floats:
        """Return the covariance of the parameters, from the jackknife and the prior information.

        `runs` has the run of each block. The jackknife also leaves out whole runs if there are at
        least `MIN_BLOCKS`.
        """
        alone = np.arange(len(self.score))
        change, size = self._changes(alone)
        # Leaving out neighboring blocks or whole runs shows errors that last longer than a block.
        if len(alone) >= MIN_PAIR_BLOCKS:
            size = np.maximum(size, self._changes(alone // 2)[1])
        if len(set(runs)) >= MIN_BLOCKS:
            size = np.maximum(size, self._changes(np.array(runs))[1])
        wider = np.sqrt(size / np.maximum(change**2, 1e-150).sum(axis=0))
        chance = change.T @ change * np.outer(wider, wider)
        information = np.zeros(PARAMETER_COUNT)
        information[list(self.prior_std)] = np.array(list(self.prior_std.values())) ** -2
        total = self.normal.sum(axis=0) + self.prior_normal
        pull = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT))
        pull[list(self.active)] = _solved(total, np.diag(information), self.active)
        return np.asarray(
            chance + pull @ np.diag(1 / np.where(information, information, np.inf)) @ pull.T
        )

    def _changes(self, group: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
        change = np.array(
            [self.without(group == number) - self.parameters for number in np.unique(group)]
        )
        squares = np.maximum(change**2, 1e-150)
        free = 3 * squares.sum(axis=0) ** 2 / (squares**2).sum(axis=0) - 2
        free = np.minimum(free, len(change) - 1)
        return change, (1 - 1 / len(change)) * student_factor(free) * squares.sum(axis=0)


def fit(
    sources: Sequence[Source], start: Floats, *, places: bool, gyro: bool = False,
    bias_std: float = 0.0, held: Sequence[Held] = (),
) -> Fit:  # fmt: skip
    """Fit the parameters to the evidence of all sensors, starting from nearly right ones.

    Without positions, the mean of the two wheel radii stays as in `start`. A `bias_std` of 0 keeps
    the gyro bias.
    """
    active = tuple(Parameter)[: Parameter.BIAS_ERROR if places else Parameter.DELAY]
    usual = dict(PRIOR_STD)
    if gyro:
        active, usual[Parameter.SCALE_ERROR] = (*active, Parameter.SCALE_ERROR), GYRO_SCALE_STD
    if bias_std:
        active, usual[Parameter.BIAS_ERROR] = (*active, Parameter.BIAS_ERROR), bias_std
    if not places:
        both = np.zeros(PARAMETER_COUNT)
        both[RADII] = 1.0
        held = (*held, (both, float(both @ start)))
    parameters, size = start.copy(), np.inf
    for at in range(MAX_STEPS):
        normal, score = _sum([source(parameters) for source in sources])
        known, prior = _prior_terms(parameters, held, usual)
        step = np.zeros(PARAMETER_COUNT)
        step[list(active)] = _solved(normal.sum(axis=0) + known, score.sum(axis=0) + prior, active)
        # Far from the solution, take only a part of the step, because the linearization holds only
        # nearby. Later, halve each step: otherwise a residual could become an outlier in every
        # second step.
        size = float(np.max(np.abs(step[: Parameter.DELAY])))
        whole = 1.0 if at < MAX_STEPS // 3 else 0.5
        parameters = parameters + step * min(whole, 0.3 / size if size else 1.0)
        if size < SMALL:
            break
    normal, score = _sum([source(parameters) for source in sources])
    known, _ = _prior_terms(parameters, held, usual)
    return Fit(parameters, normal, score, known, active, size < SETTLED, usual)


def _sum(evidence: Sequence[Evidence]) -> tuple[Floats, Floats]:
    normal, score = np.zeros_like(evidence[0].normal), np.zeros_like(evidence[0].score)
    for part in evidence:
        weight = _weight(part)
        normal, score = normal + weight * part.normal, score + weight * part.score
    return normal, score


def _weight(part: Evidence) -> float:
    # From the differences between blocks, which unlike residuals grow if residuals are correlated.
    total = part.normal.sum(axis=0)
    used = np.flatnonzero(np.diag(total) > 0.0)
    if not len(used):
        return 0.0
    inner = np.linalg.pinv(total[np.ix_(used, used)], rcond=1e-10, hermitian=True)
    rank = int(np.linalg.matrix_rank(inner, hermitian=True))
    # The mean is not noise until the fit has converged.
    apart = part.score[:, used] - part.score[:, used].mean(axis=0)
    noise = float(np.einsum("bi,ij,bj->", apart, inner, apart))
    white = float(part.squares.sum() / max(1.0, part.counts.sum()))
    return 1.0 / max(noise / max(1, rank), white, 1e-18)


def _prior_terms(
    parameters: Floats, targets: Sequence[Held], usual: Mapping[Parameter, float]
) -> tuple[Floats, Floats]:
    normal, score = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT)), np.zeros(PARAMETER_COUNT)
    for index, deviation in usual.items():
        normal[index, index] = deviation**-2
        score[index] = -parameters[index] * deviation**-2
    for weights, value in targets:
        normal += CONSTRAINT_WEIGHT * np.outer(weights, weights)
        score += CONSTRAINT_WEIGHT * weights * (value - weights @ parameters)
    return normal, score


def _solved(normal: Floats, score: Floats, active: Sequence[int]) -> Floats:
    part = normal[np.ix_(active, active)]
    return np.asarray(np.linalg.lstsq(part, score[list(active)], rcond=1e-15)[0])
