"""Checks that a log contains enough movement, and advice on what to drive if it does not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acsard.calibration.doubts import RefusedError
from acsard.calibration.fit import LEAST_BLOCKS
from acsard.calibration.heading import Rows
from acsard.calibration.multipliers import LEFT_RADIUS, RIGHT_RADIUS, Multipliers
from acsard.calibration.paths import Block
from acsard.calibration.table import Floats

LEAST_TURN = 2 * np.pi
"""Smallest total turn of the robot, rad."""

LEAST_ROLL = 3.0
"""Smallest total roll of the wheels, rad, both in the same direction and against each other."""

ALIKE = 0.98
"""Squared correlation of both rolls above which they count as a single movement."""

WORST_TRACK, WORST_RATIO = 0.2, 0.03
"""Largest useful standard deviations, as fractions: of the track by chance, of the radii ratio."""

WORST_CONDITION = 1e4
"""Largest condition number of the scaled normal equations at which parameters can be told apart."""

DRIVE = (
    "drive 60 s: stand 3 s, 2 m straight ahead and back, three full turns to the left and three to "
    "the right, some of them slow and some fast, then curves both ways"
)


def drives_enough(parts: Sequence[Block]) -> None:
    """Raise `RefusedError` if the wheels hardly move at all."""
    if len(parts) < LEAST_BLOCKS:
        seconds = sum(part.end - part.begin for part in parts)
        raise RefusedError(f"the wheels turn for {seconds:.0f} s only, too little: {DRIVE}")


def rolls_enough(rows: Rows) -> None:
    """Raise `RefusedError` if the wheels lack a movement that the fit needs.

    They must roll together and against each other, and not always in the same proportion.
    """
    together, against = (rows.right + rows.left) / 2, (rows.right - rows.left) / 2
    for rolled, what in ((together, "ahead or back"), (against, "against each other")):
        if (turns := float(np.abs(rolled).sum()) / (2 * np.pi)) < LEAST_ROLL / (2 * np.pi):
            raise RefusedError(
                f"the wheels roll {turns:.1f} turns {what} in all, which is too little to tell "
                f"their size, left to right and the effective track: {DRIVE}"
            )
    cross = float(together @ against) ** 2
    if cross > ALIKE * float(together @ together) * float(against @ against):
        raise RefusedError(
            f"the robot drives one and the same circle, which tells nothing: {DRIVE}"
        )


def turns_enough(turned: Floats) -> None:
    """Raise `RefusedError` if the robot hardly turns. `turned` is in rad per row."""
    if (angle := float(np.abs(turned).sum())) < LEAST_TURN:
        raise RefusedError(
            f"the robot turned by {np.degrees(angle):.0f} deg in all, which is too little for the "
            f"effective track: {DRIVE}"
        )


def sure_enough(found: Multipliers, chance: float) -> None:
    """Raise `RefusedError` if the result is too uncertain to be useful.

    `chance` is the standard deviation of the track as a fraction, without the track's own
    variation.
    """
    size = np.outer(found.values, found.values)
    share = found.covariance / size
    ratio = share[LEFT_RADIUS, LEFT_RADIUS] + share[RIGHT_RADIUS, RIGHT_RADIUS]
    ratio = float(np.sqrt(max(0.0, ratio - 2 * share[LEFT_RADIUS, RIGHT_RADIUS])))
    told = {"the effective track": (chance, WORST_TRACK), "left to right": (ratio, WORST_RATIO)}
    for name, (deviation, worst) in told.items():
        if not deviation <= worst:
            raise RefusedError(
                f"{name} comes out of this log only to {deviation:.1%}, which is of no use: {DRIVE}"
            )


def told_apart(normal: Floats) -> None:
    """Raise `RefusedError` if the log cannot separate the radii from the track.

    `normal` is the result of `Fit.apart`.
    """
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0.0) or np.linalg.cond(normal / np.outer(size, size)) > WORST_CONDITION:
        raise RefusedError(
            f"the log turns and goes ahead only together, so that the track and the wheels cannot "
            f"be told apart (condition number over {WORST_CONDITION:g}): {DRIVE}"
        )
