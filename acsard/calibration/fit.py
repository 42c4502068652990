"""All sources together -> the parameters and how sure they are.

Gauss-Newton on sums over blocks. The standard deviations are a jackknife's over the blocks: each
is left out in turn, and what that changes is what chance can do, however the errors within a block
hang together (Quenouille's and Tukey's; with the step linear, its one-step form). Few blocks are
answered for with the spread of Student's t.

The effective track of a skidding robot is no constant. So its standard deviation also has what the
constant does not say: half of how much it changes from slow to fast turns, or how much it differs
from block to block, whichever is more.
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
    Evidence,
)  # fmt: skip
from acsard.calibration.table import Floats

Source = Callable[[Floats], Evidence]

MOST_STEPS = 30
SMALL, SETTLED = 1e-5, 0.02
"""A step that ends the search, and one that may be its last."""

USUAL = {RATE: 0.06, LATE: 1.0, AHEAD: 0.5, ASIDE: 0.5}
"""Standard deviations before anything is seen, of parameters that a log may not tell: by which
share a track grows with each rad/s, s, m, m."""

GYRO_SCALE = 0.005
"""The same of what a gyro calls one rad/s, of a usual MEMS gyro: no log of it alone shows that."""

HELD = 1e9
"""Weight by which the mean radius is held where nothing measures it."""

MANY = 16
"""Blocks that make enough pairs."""

LEAST_FREE = 3.0
"""Of Student's t, which has no standard deviation at 2."""

LEAST_BLOCKS = 5
"""Fewer say too little of how they differ."""


class Fit(Struct, frozen=True):
    """The parameters, and what each block said of them at the end."""

    parameters: Floats
    normal: Floats
    """blocks x COUNT x COUNT."""
    score: Floats
    """blocks x COUNT."""
    known: Floats
    """COUNT x COUNT: what was known beforehand."""
    active: tuple[int, ...]
    varies: float
    """Share by which the effective track differs from block to block."""
    converged: bool
    usual: Mapping[int, float]
    """Standard deviations before anything is seen."""

    def without(self, blocks: npt.NDArray[np.bool_]) -> Floats:
        """The parameters if those blocks (a mask) were not there; one step, linear."""
        rest = self.normal[~blocks].sum(axis=0) + self.known
        found = self.parameters.copy()
        found[list(self.active)] -= _solved(rest, self.score[blocks].sum(axis=0), self.active)
        return found

    def apart(self) -> Floats:
        """Normal equations of left, right and turn, with all that goes with them taken out; where
        the mean radius is held, of left against right and turn."""
        total = self.normal.sum(axis=0) + self.known
        rest = [index for index in self.active if index > TURN]
        inner, cross = total[np.ix_(rest, rest)], total[np.ix_([LEFT, RIGHT, TURN], rest)]
        three = np.asarray(total[:3, :3] - cross @ np.linalg.solve(inner, cross.T))
        free = np.eye(3) if LATE in self.active else np.array([[-0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(free @ three @ free.T)

    def covariance(self) -> Floats:
        """Of the parameters: by chance, and by what was only held to be usual."""
        alone = self._jackknife(1)
        size = np.sqrt(np.maximum(np.diag(alone), 1e-300))
        # Errors that last longer than a block show when neighbours are left out together.
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
        """Covariance by leaving out so many neighbouring blocks at a time."""
        group = np.arange(len(self.score)) // together
        change = np.array(
            [self.without(group == number) - self.parameters for number in range(group[-1] + 1)]
        )
        # A variance that few of the groups make up is known as badly as of so few.
        squares = np.maximum(change**2, 1e-150)
        free = np.maximum(LEAST_FREE, squares.sum(axis=0) ** 2 / (squares**2).sum(axis=0))
        student = np.sqrt(free / (free - 2))
        covariance = (1 - 1 / len(change)) * change.T @ change
        return np.asarray(covariance * np.outer(student, student))


def fit(
    sources: Sequence[Source], start: Floats, *, places: bool, gyro: bool = False,
    drift: float = 0.0,
) -> Fit:  # fmt: skip
    """From parameters that are nearly right; what is among the sources: positions, a gyro.

    `drift`: standard deviation of the gyro's bias, rad/s, 0 where that is taken out of all.
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
        # Far off, only part of the way: the path must stay near what it is linear about.
        # Later on, half of it, lest outliers count and not in turn.
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
    """Of all sources, each weighed by what its blocks' scores show of its noise: residuals that
    hang together say less than as many that do not."""
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
    # About their mean, which is not noise while the parameters are still off.
    apart = one.score[:, used] - one.score[:, used].mean(axis=0)
    noise = float(np.einsum("bi,ij,bj->", apart, inner, apart))
    white = float(one.squares.sum() / max(1.0, one.counts.sum()))
    return 1.0 / max(noise / max(1, rank), white, 1e-18)


def _known(
    parameters: Floats, held: float, places: bool, usual: Mapping[int, float]
) -> tuple[Floats, Floats]:
    """What is known beforehand, as normal equations."""
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
    """Of the active parameters; the rest is held."""
    part = normal[np.ix_(active, active)]
    return np.asarray(np.linalg.lstsq(part, score[list(active)], rcond=1e-15)[0])


def _varies(found: Sequence[Evidence], parameters: Floats) -> float:
    """Share by which the track differs from block to block, beyond the noise within them.

    Of random effects, the estimate by moments (DerSimonian & Laird 1986).
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
