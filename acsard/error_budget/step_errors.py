"""Divides a drive into steps, each with the errors of one cause.

An error is either independent of all others, and then it is a variance. Or it has the same sign in
each step and adds up. Then it is treated like a motion that the pose missed, as in a gap.

Rounding is an error because a line carries speeds with two decimals. Independent rounding has a
standard deviation of q / sqrt(12), where q is the quantization step. A wheel at a constant speed
repeats the same error, so a run of equal values counts as one error of the run's length. A run that
a wheel passes on its way from slower to faster is different: the errors of its two halves cancel.

A firmware that counts encoder edges in each period reports multiples of one count's speed. An edge
that it misses in one period is counted in the next, so only the rounding of each multiple adds up,
and that is known.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.motion.error_model import DECIMAL
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import WheelSpeeds
from acsard.error_budget.drive_log import BLOCK_S, Line, Motion, Stood

Floats = npt.NDArray[np.float64]

COARSE = 2.5 * DECIMAL
"""Smallest step in rad/s between multiples that can be distinguished from arbitrary two-decimal
values."""

FIT, SHARE = 0.0055, 0.99
"""Largest deviation of a rounded multiple in rad/s, and the share of values that must be within
it."""

CHANCE = 1e-3
"""Accepted probability that arbitrary speeds look like multiples of the step between two of
them."""

TOGETHER = 0.8
"""Share of lines with equal values from which two wheels are assumed to have the same error."""


class Rounding(Struct, frozen=True):
    """Rounding errors; rows are lines, columns are wheels in `values.WHEELS` order."""

    variance: Floats
    """Variance of each value, rad2; the entries are independent."""
    offset: Floats
    """Known excess of each value, rad."""
    alike: Floats
    """For each pair of wheels 1 if their errors are the same, otherwise 0."""
    quantum: float
    """Quantization step, rad/s."""
    count: float
    """Wheel rotation per encoder count, rad; 0 if the lines do not show it."""


def rounding(speeds: Floats, period: float) -> Rounding:
    """Estimate the rounding errors of wheel speeds in rad/s; each line covers `period` s."""
    moving = np.any(speeds != 0.0, axis=1)
    same = speeds[moving][:, :, None] == speeds[moving][:, None, :]
    alike = (same.mean(axis=0) >= TOGETHER).astype(float) if moving.any() else np.eye(4)
    lattice = _lattice(speeds)
    if lattice:
        off = (speeds - lattice * np.round(speeds / lattice)) * period
        return Rounding(np.zeros_like(speeds), off, alike, lattice, lattice * period)
    variance = np.column_stack([_runs(column) for column in speeds.T])
    scale = (DECIMAL * period) ** 2 / 12
    return Rounding(variance * scale, np.zeros_like(speeds), alike, DECIMAL, 0.0)


def _runs(values: Floats) -> Floats:
    """Return the variance of each run at its last line, in units of q^2 / 12.

    It is the square of the run's length, or 1 for a run that is passed through.
    """
    found = np.zeros(len(values))
    ends = np.append(np.flatnonzero(np.diff(values)), len(values) - 1)
    starts = np.append(0, ends[:-1] + 1)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if values[start] == 0.0:
            continue  # the wheel stands still
        length = end - start + 1
        if start > 0 and end + 1 < len(values):
            before, after = values[start - 1] - values[start], values[end + 1] - values[start]
            length = 1 if before * after < 0.0 else length
        found[end] = length**2
    return found


def _lattice(speeds: Floats) -> float:
    """Return the speed in rad/s of which all speeds are multiples, or 0 if there is none."""
    values = np.unique(np.append(np.abs(speeds), 0.0))
    step = float(np.min(np.diff(values), initial=math.inf))
    if not COARSE <= step < math.inf or (2 * FIT / step) ** (len(values) - 2) > CHANCE:
        return 0.0
    apart = np.diff(values)
    # Most neighbours are one step apart. Their mean is precise enough to number the distant values.
    step = float(apart[apart < 1.5 * step].mean())
    for _ in range(2):
        number = np.round(values / step)
        step = float(values @ number / (number @ number))
    off = np.abs(values - step * np.round(values / step))
    return step if float(np.mean(off <= FIT)) >= SHARE else 0.0


NEVER: dict[int, Stood] = {}


class Step(Struct, frozen=True):
    """A step of a drive: distance in m, turn in rad, and its errors.

    `along` (m2) and `yaw` (rad2) are variances that are independent of other steps. `stood` is an
    error that is common to all steps. `by_gyro` (rad2) is the variance of a turn that a gyro
    measured, None for a turn by the wheels.
    """

    distance: float
    turn: float
    along: float = 0.0
    yaw: float = 0.0
    stood: Stood | None = None
    by_gyro: float | None = None


class Driving:
    """A drive, divided into steps of about `step_s` seconds."""

    def __init__(
        self, lines: list[Line], motion: Motion, rounding: Rounding, kinematics: Kinematics,
        step_s: float, gyro: bool,
    ) -> None:  # fmt: skip
        self._lines, self._motion, self._rounding, self._gyro = lines, motion, rounding, gyro
        self._each = max(1, round(step_s / motion.period))
        twists = [kinematics.twist(WheelSpeeds(*row)) for row in np.eye(4).tolist()]
        self._weights = np.array([[one.linear for one in twists], [one.angular for one in twists]])
        """Motion of the robot for 1 rad of each wheel: a row of m and a row of rad."""

    def plain(self) -> list[Step]:
        """Return the steps without an error."""
        return self._steps()

    @property
    def tells_gyro(self) -> bool:
        """Whether the data shows the noise of the gyro."""
        return self._motion.yaw_variance is not None

    def turned_by_gyro(self) -> list[Step]:
        """Return the steps with the gyro noise that odometry assumes."""
        return self._steps(gyro=self._motion.yaw_variance)

    def late(self) -> list[Step]:
        """Return the steps with the errors of late lines.

        Correlated errors are summed before they are squared.
        """
        late = self._motion.late
        starts = np.arange(0, len(late), max(1, round(BLOCK_S / self._motion.period)))
        squares = np.zeros_like(late)
        squares[starts] = np.add.reduceat(late, starts, axis=0) ** 2
        return self._steps(squares)

    def missed(self) -> list[Step]:
        """Return the steps with the errors of gaps; empty if there was no gap."""
        moved = self._motion
        seen = not moved.stood and not moved.bridged.any()
        return [] if seen else self._steps(moved.bridged, moved.stood)

    def rounded(self) -> list[Step]:
        """Return the steps with the rounding errors of lines.

        An encoder's own resolution is not included.
        """
        found = self._rounding
        if found.count:
            return self._steps(stood=_biased(found.offset[1:] @ self._weights.T))
        roots = np.sqrt(found.variance[1:])
        variances = [
            np.einsum("ki,ij,kj->k", roots * row, found.alike, roots * row) for row in self._weights
        ]
        return self._steps(np.column_stack(variances))

    def contradicted(self) -> list[Step]:
        """Return the steps with the errors that contradicting wheels imply; empty without
        contradiction.

        If the front and the rear wheel of a side disagree and one is right, their mean is off by
        half the difference.
        """
        turned = np.diff([line.positions for line in self._lines], axis=0)
        front_right, front_left, rear_left, rear_right = turned.T
        right, left = (front_right - rear_right) / 2, (front_left - rear_left) / 2
        off = np.column_stack([right, left, left, right])
        return self._steps(stood=_biased(off @ self._weights.T)) if off.any() else []

    def _steps(
        self, variances: Floats | None = None, stood: dict[int, Stood] = NEVER,
        gyro: Floats | None = None,
    ) -> list[Step]:  # fmt: skip
        """Sum the lines' errors into steps; `variances` has rows of (m2, rad2), one for each
        line."""
        moved, each = self._motion, self._each
        starts = np.arange(0, len(moved.distance), each)
        distance, turn = (np.add.reduceat(all_, starts) for all_ in (moved.distance, moved.turn))
        of = np.zeros((len(starts), 2))
        if variances is not None:
            of = np.add.reduceat(variances, starts, axis=0)
        heading = np.zeros(len(starts)) if gyro is None else np.add.reduceat(gyro, starts)
        lost: dict[int, Stood] = {}
        for line, one in stood.items():
            lost[line // each] = _both(lost.get(line // each, Stood()), one)
        rows = zip(distance.tolist(), turn.tolist(), of.tolist(), heading.tolist(), strict=True)
        if not self._gyro:
            return [
                Step(d, w, row[0], row[1], lost.get(i)) for i, (d, w, row, _) in enumerate(rows)
            ]
        # The gyro determines the heading, so wheel errors do not affect it.
        for i, one in lost.items():
            lost[i] = replace(one, turn=0.0, yaw=0.0)
        return [Step(d, w, row[0], 0.0, lost.get(i), h) for i, (d, w, row, h) in enumerate(rows)]


def mirrored(step: Step) -> Step:
    """Return the step as a turn to the left."""
    if step.turn >= 0.0:
        return step
    stood = step.stood
    if stood is not None:
        stood = replace(stood, turn=-stood.turn)
    return replace(step, turn=-step.turn, stood=stood)


def _biased(off: Floats) -> dict[int, Stood]:
    """Return errors that keep their sign, from rows of (m, rad) for each line."""
    return {k: Stood(*row) for k, row in enumerate(off.tolist()) if any(row)}


def _both(a: Stood, b: Stood) -> Stood:
    return Stood(a.distance + b.distance, a.turn + b.turn, a.along + b.along, a.yaw + b.yaw)
