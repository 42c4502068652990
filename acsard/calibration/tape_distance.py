"""A distance measured by tape, which gives the size of the wheels to a log of turn rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.doubts import RefusedError
from acsard.calibration.fit import LEFT_RADIUS, RIGHT_RADIUS, SEPARATION, Multipliers
from acsard.calibration.log_table import Floats

TAPE_M = 0.01
"""Standard deviation of a distance by tape, including where on the robot it was measured, m."""

UNKNOWN = 1.0
"""Standard deviation of the scale's logarithm if nothing else has measured it."""

LEAST_M = 0.5
"""Shortest distance of a run's end from its start by odometry that can be used, m."""

STRAIGHT = 0.8
"""Smallest distance from start to end, as a fraction of the way between them."""


class Tape(Struct, frozen=True):
    """Straight-line distance of a run's end from its start, m.

    If `run` is "", the straightest run is meant.
    """

    metres: float
    run: str = ""


class Way(Struct, frozen=True):
    """The way of a run for given multipliers: from start to end, and along the path, m."""

    apart: float
    along: float

    @property
    def straight(self) -> float:
        """Straightness: 1 for a straight line, 0 for a run that gets nowhere."""
        return self.apart / self.along if self.apart > LEAST_M else 0.0


Follow = Callable[[Floats, int], Way]
"""Function from multipliers (as in `Multipliers.values`) and a run's number to its way."""


def scaled(
    found: Multipliers, tape: Tape, names: Sequence[str], follow: Follow, *, known: bool
) -> tuple[Multipliers, str]:
    """Return the multipliers corrected by the distance, and the name of the run it was used for.

    The correction is a Kalman step in the logarithms of the multipliers. `known` says whether
    positions have already measured the scale. Raises `RefusedError` if there is no such run or if
    no run is straight enough.
    """
    if tape.run and tape.run not in names:
        raise RefusedError(
            f'--distance: there is no run "{tape.run}" in the log; it has {", ".join(names[:10])}'
        )
    numbers = [names.index(tape.run)] if tape.run else range(len(names))
    ways = {number: follow(found.values, number) for number in numbers}
    best = max(ways, key=lambda number: ways[number].straight)
    way = ways[best]
    if way.straight < STRAIGHT:
        raise RefusedError(
            f"--distance: run {names[best]} ends {way.apart:.2f} m from its start, after "
            f"{way.along:.2f} m: drive straight ahead for 2 m or more in a separate run, and "
            "measure from start to end"
        )
    slopes = np.zeros(3)
    for index in (SEPARATION, LEFT_RADIUS, RIGHT_RADIUS):
        longer = found.values.copy()
        longer[index] *= 1.0 + 1e-4
        slopes[index] = np.log(follow(longer, best).apart / way.apart) / 1e-4
    logs = np.diag(1 / found.values)
    covariance = logs @ found.covariance @ logs
    if not known:
        covariance = covariance + UNKNOWN**2
    noise = (TAPE_M / tape.metres) ** 2
    pull = covariance @ slopes / (slopes @ covariance @ slopes + noise)
    values = found.values * np.exp(pull * np.log(tape.metres / way.apart))
    rest = np.eye(3) - np.outer(pull, slopes)
    covariance = rest @ covariance @ rest.T + np.outer(pull, pull) * noise
    back = np.diag(values)
    return Multipliers(values, back @ covariance @ back), names[best]
