"""Fits the parameters to all sources together, with their uncertainty, and makes settings of them.

The fit is Gauss-Newton on sums over blocks. The standard deviations come from a jackknife over the
blocks: each block is left out in turn, and the resulting change shows the effect of chance,
whatever the correlation of errors within a block (Quenouille and Tukey; since the step is linear,
this is the one-step form). If there are few blocks, the deviation is widened to that of Student's
t.

The effective track of a skidding robot is not constant. Its standard deviation therefore also
includes the larger of two terms: half of its change from slow to fast turns, and its variation from
block to block. `Multipliers` has the settings of `[drive]` that follow from a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.evidence import (
    AHEAD,
    ASIDE,
    COUNT,
    DRIFT,
    LATE,
    LEFT,
    RATE,
    RIGHT,
    STRETCH,
    TURN,
    Base,
    Evidence,
)  # fmt: skip
from acsard.calibration.heading import Rows
from acsard.calibration.log_table import Floats

Source = Callable[[Floats], Evidence]

MOST_STEPS = 30
SMALL, SETTLED = 1e-5, 0.02
"""Size of a step that ends the search, and size below which the last step counts as converged."""

USUAL = {RATE: 0.06, LATE: 1.0, AHEAD: 0.5, ASIDE: 0.5}
"""Prior standard deviations of parameters that a log may not determine.

They are the growth of the track, as a fraction per rad/s, the delay in s, and two lengths in m.
"""

GYRO_SCALE = 0.005
"""Prior standard deviation of a gyro's scale, a fraction, for a usual MEMS gyro.

A log of a gyro alone cannot show this error.
"""

HELD = 1e9
"""Weight that holds the mean radius if no source measures it."""

MANY = 16
"""Number of blocks from which on neighbouring pairs are left out as well."""

LEAST_FREE = 3.0
"""Smallest degrees of freedom for Student's t, which has no standard deviation at 2."""

LEAST_BLOCKS = 5
"""Smallest number of blocks. Fewer do not show how much blocks differ."""


class Fit(Struct, frozen=True):
    """The parameters found, and the normal equations of each block at that point."""

    parameters: Floats
    normal: Floats
    """Normal equations, shape (blocks, COUNT, COUNT)."""
    score: Floats
    """Right-hand sides, shape (blocks, COUNT)."""
    known: Floats
    """Prior information as normal equations, shape (COUNT, COUNT)."""
    active: tuple[int, ...]
    varies: float
    """Fraction by which the effective track differs from block to block."""
    converged: bool
    usual: Mapping[int, float]
    """Prior standard deviation of each parameter that has one."""

    def without(self, blocks: npt.NDArray[np.bool_]) -> Floats:
        """Return the parameters without the blocks of this mask, by one linear step."""
        rest = self.normal[~blocks].sum(axis=0) + self.known
        found = self.parameters.copy()
        found[list(self.active)] -= _solved(rest, self.score[blocks].sum(axis=0), self.active)
        return found

    def apart(self) -> Floats:
        """Return the normal equations of left, right and turn with all other parameters eliminated.

        If the mean radius is held, the result has two parameters: left against right, and turn.
        """
        total = self.normal.sum(axis=0) + self.known
        rest = [index for index in self.active if index > TURN]
        inner, cross = total[np.ix_(rest, rest)], total[np.ix_([LEFT, RIGHT, TURN], rest)]
        three = np.asarray(total[:3, :3] - cross @ np.linalg.solve(inner, cross.T))
        free = np.eye(3) if LATE in self.active else np.array([[-0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(free @ three @ free.T)

    def covariance(self) -> Floats:
        """Return the covariance of the parameters from chance and from prior assumptions."""
        alone = self._jackknife(1)
        size = np.sqrt(np.maximum(np.diag(alone), 1e-300))
        # Leaving out neighbours together shows errors that last longer than a block.
        paired = np.sqrt(np.diag(self._jackknife(2))) if len(self.score) >= MANY else size
        wider = np.maximum(1.0, paired / size)
        chance = alone * np.outer(wider, wider)
        usual = np.zeros(COUNT)
        usual[list(self.usual)] = np.array(list(self.usual.values())) ** -2
        total = self.normal.sum(axis=0) + self.known
        pull = np.zeros((COUNT, COUNT))
        pull[list(self.active)] = _solved(total, np.diag(usual), self.active)
        return np.asarray(chance + pull @ np.diag(1 / np.where(usual, usual, np.inf)) @ pull.T)

    def _jackknife(self, together: int) -> Floats:
        """Return the covariance from leaving out groups of `together` neighbouring blocks."""
        group = np.arange(len(self.score)) // together
        change = np.array(
            [self.without(group == number) - self.parameters for number in range(group[-1] + 1)]
        )
        # If a few groups make up most of a variance, it has as few degrees of freedom as those
        # groups.
        squares = np.maximum(change**2, 1e-150)
        free = np.maximum(LEAST_FREE, squares.sum(axis=0) ** 2 / (squares**2).sum(axis=0))
        student = np.sqrt(free / (free - 2))
        covariance = (1 - 1 / len(change)) * change.T @ change
        return np.asarray(covariance * np.outer(student, student))


def fit(
    sources: Sequence[Source], start: Floats, *, places: bool, gyro: bool = False,
    drift: float = 0.0,
) -> Fit:  # fmt: skip
    """Fit the parameters, starting from parameters that are nearly right.

    Args:
        sources: functions from parameters to their evidence.
        start: the parameters to start from.
        places: whether positions are among the sources.
        gyro: whether a gyro is among the sources.
        drift: standard deviation of the gyro bias, rad/s; 0 if the bias was eliminated from the
            rows.
    """
    active: tuple[int, ...] = (LEFT, RIGHT, TURN, RATE, LATE, AHEAD, ASIDE)[: None if places else 4]
    usual = dict(USUAL)
    if gyro:
        active, usual[STRETCH] = (*active, STRETCH), GYRO_SCALE
    if drift:
        active, usual[DRIFT] = (*active, DRIFT), drift
    held = start[LEFT] + start[RIGHT]
    parameters, size = start.copy(), np.inf
    for at in range(MOST_STEPS):
        normal, score = _sum([source(parameters) for source in sources])
        known, told = _known(parameters, held, places, usual)
        step = np.zeros(COUNT)
        step[list(active)] = _solved(normal.sum(axis=0) + known, score.sum(axis=0) + told, active)
        # Far from the solution, go only part of the way: the path must stay near its linearization
        # point. After a third of the steps, halve each step, so that outliers do not alternately
        # count and not count.
        size = float(np.max(np.abs(step[: RATE + 1])))
        whole = 1.0 if at < MOST_STEPS // 3 else 0.5
        parameters = parameters + step * min(whole, 0.3 / size if size else 1.0)
        if size < SMALL:
            break
    found = [source(parameters) for source in sources]
    normal, score = _sum(found)
    known, _ = _known(parameters, held, places, usual)
    varies = _varies(found, parameters)
    return Fit(parameters, normal, score, known, active, varies, size < SETTLED, usual)


def _sum(found: Sequence[Evidence]) -> tuple[Floats, Floats]:
    """Sum the evidence of all sources. Each is weighted by the noise that its blocks' scores show.

    Correlated residuals contain less information than the same number of independent ones.
    """
    normal, score = np.zeros_like(found[0].normal), np.zeros_like(found[0].score)
    for one in found:
        weight = _weight(one)
        normal, score = normal + weight * one.normal, score + weight * one.score
    return normal, score


def _weight(one: Evidence) -> float:
    total = one.normal.sum(axis=0)
    used = np.flatnonzero(np.diag(total) > 0.0)
    if not len(used):
        return 0.0
    inner = np.linalg.pinv(total[np.ix_(used, used)], rcond=1e-10, hermitian=True)
    rank = int(np.linalg.matrix_rank(inner, hermitian=True))
    # Take the deviations from the mean: while the parameters are still off, the mean is not noise.
    apart = one.score[:, used] - one.score[:, used].mean(axis=0)
    noise = float(np.einsum("bi,ij,bj->", apart, inner, apart))
    white = float(one.squares.sum() / max(1.0, one.counts.sum()))
    return 1.0 / max(noise / max(1, rank), white, 1e-18)


def _known(
    parameters: Floats, held: float, places: bool, usual: Mapping[int, float]
) -> tuple[Floats, Floats]:
    """Return the prior information as normal equations."""
    normal, score = np.zeros((COUNT, COUNT)), np.zeros(COUNT)
    for index, deviation in usual.items():
        normal[index, index] = deviation**-2
        score[index] = -parameters[index] * deviation**-2
    if not places:
        both = np.zeros(COUNT)
        both[[LEFT, RIGHT]] = 1.0
        normal += HELD * np.outer(both, both)
        score += HELD * both * (held - parameters[LEFT] - parameters[RIGHT])
    return normal, score


def _solved(normal: Floats, score: Floats, active: Sequence[int]) -> Floats:
    """Solve for the active parameters. All others keep their value."""
    part = normal[np.ix_(active, active)]
    return np.asarray(np.linalg.lstsq(part, score[list(active)], rcond=1e-15)[0])


def _varies(found: Sequence[Evidence], parameters: Floats) -> float:
    """Return the fraction by which the track differs between blocks, beyond the noise within them.

    This is the moment estimator for random effects (DerSimonian & Laird 1986).
    """
    spread = weight = 0.0
    for one in found:
        share = _weight(one)
        size, pull = share * one.normal[:, TURN, TURN], share * one.score[:, TURN]
        seen = size > 0.0
        own = pull[seen] ** 2 / size[seen]
        free = max(1.0, float(one.counts[seen].sum() - seen.sum()))
        noise = max(0.0, float(share * one.squares[seen].sum() - own.sum())) / free
        spread += float(own.sum()) - noise * int(seen.sum())
        weight += float(size.sum())
    return float(np.sqrt(max(0.0, spread) / weight)) / abs(parameters[TURN]) if weight else 0.0


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

    @property
    def ratio_std(self) -> float:
        """Standard deviation of the ratio of both radii, as a fraction."""
        shares = self.covariance / np.outer(self.values, self.values)
        apart = np.array([0.0, 1.0, -1.0])
        return float(np.sqrt(max(0.0, apart @ shares @ apart)))

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
