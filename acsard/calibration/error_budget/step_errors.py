"""Divides a drive into steps, each with the errors of one cause.

An error that is independent from step to step is given as a variance. An error that has the same
sign in each step adds up; it is given as motion that the pose missed, like the motion in a gap.

Rounding is an error because a feedback line carries wheel speeds with two decimals. Independent
rounding errors have a standard deviation of q / sqrt(12), where q is the quantization step. A wheel
at a constant speed repeats the same error, so a run of n equal values is one error of n times this
size. If a wheel passes through a value while it becomes faster or slower, the run is different: the
errors of its first and second half cancel.

Some firmware counts encoder edges in each period and reports multiples of the speed of one count.
An edge that it misses in one period is counted in the next one. Only the rounding of the reported
multiple to two decimals adds up then, and this rounding is known.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.error_budget.drive_log import BLOCK_S, Line, Motion
from acsard.core.link.quantization_step import Search
from acsard.core.motion.error_model import DECIMAL
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import WheelSpeeds

Floats = npt.NDArray[np.float64]

TOGETHER = 0.8
"""Part of the feedback lines with equal values from which two wheels have the same errors."""

LEAST_VALUES = 3
"""Number of different speeds that are needed to find a quantization step."""


class Rounding(Struct, frozen=True):
    """Rounding errors. Rows are feedback lines, columns are wheels in `values.WHEELS` order."""

    variance: Floats
    """Variance of the angle that a wheel rolled, rad2. The entries are independent."""
    offset: Floats
    """Known error of the angle that a wheel rolled, rad."""
    alike: Floats
    """Shape (4, 4): 1 for a pair of wheels with the same errors, otherwise 0."""
    quantum: float
    """Quantization step, rad/s."""
    count: float
    """Wheel rotation per encoder count, rad; 0 if the feedback lines do not show it."""


def rounding(speeds: Floats, period: float) -> Rounding:
    """Estimate the rounding errors of wheel speeds.

    `speeds` has one row for each feedback line, in rad/s. A feedback line covers `period` s.
    """
    moving = np.any(speeds != 0.0, axis=1)
    same = speeds[moving][:, :, None] == speeds[moving][:, None, :]
    alike = (same.mean(axis=0) >= TOGETHER).astype(float) if moving.any() else np.eye(4)
    quantum = _quantum(speeds)
    if quantum:
        off = (speeds - quantum * np.round(speeds / quantum)) * period
        return Rounding(np.zeros_like(speeds), off, alike, quantum, quantum * period)
    variance = np.column_stack([_runs(column) for column in speeds.T])
    scale = (DECIMAL * period) ** 2 / 12
    return Rounding(variance * scale, np.zeros_like(speeds), alike, DECIMAL, 0.0)


def _runs(values: Floats) -> Floats:
    """Return the variance of each run of equal values of a wheel, in units of q^2 / 12.

    The variance is in the row of the run's last value, and the other rows are 0. It is the square
    of the number of values, or 1 if the wheel passed through the value.
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


def _quantum(speeds: Floats) -> float:
    """Return the speed in rad/s of which all speeds are multiples, or 0 without such a speed."""
    # A value that is repeated for a whole drive is no more evidence than a single one.
    seen = np.unique(np.abs(speeds[speeds != 0.0])).tolist()
    if len(seen) < LEAST_VALUES:
        return 0.0
    search = Search(dict.fromkeys(seen, 1))
    while not search.go_on():
        pass
    return search.found.quantum if search.found is not None else 0.0


class Steps(Struct, frozen=True):
    """The steps of a drive with the errors of one cause."""

    rows: Floats
    """One row for each step, with nine columns:

    - 0, 1: distance (m) and turn (rad) of the step
    - 2, 3: variances of both (m2, rad2) that are independent of other steps
    - 4, 5: motion that the pose missed (m, rad), with the same sign in each step
    - 6, 7: variances of the missed motion (m2, rad2)
    - 8: variance of the turn if a gyro measured it (rad2)
    """
    by_gyro: bool = False
    """Whether a gyro measured the turns. Otherwise the wheels did."""

    def to_the_left(self) -> Steps:
        """Return the steps with every turn to the left.

        The missed turn of a step to the right changes its sign as well.
        """
        rows = self.rows.copy()
        rows[rows[:, 1] < 0.0] *= (1, -1, 1, 1, 1, -1, 1, 1, 1)
        return Steps(rows, self.by_gyro)


class Driving:
    """A drive, divided into steps of about `step_s` s, with the errors of each cause."""

    def __init__(
        self, lines: list[Line], motion: Motion, rounding: Rounding, kinematics: Kinematics,
        step_s: float, gyro: bool,
    ) -> None:  # fmt: skip
        self._lines, self._motion, self._rounding, self._gyro = lines, motion, rounding, gyro
        self._each = max(1, round(step_s / motion.period))
        twists = [kinematics.twist(WheelSpeeds(*row)) for row in np.eye(4).tolist()]
        self._weights = np.array([[t.linear for t in twists], [t.angular for t in twists]])
        """Motion of the robot for 1 rad of each wheel: a row of m and a row of rad."""

    def plain(self) -> Steps:
        """Return the steps without an error."""
        return self._steps()

    @property
    def tells_gyro(self) -> bool:
        """Whether the feedback lines show the noise of the gyro."""
        return self._motion.yaw_variance is not None

    def turned_by_gyro(self) -> Steps:
        """Return the steps with the gyro noise that odometry assumes."""
        return self._steps(gyro=self._motion.yaw_variance)

    def late(self) -> Steps:
        """Return the steps with the errors of wrong times of feedback lines.

        The errors within `BLOCK_S` are correlated, so they are summed before they are squared.
        """
        late = self._motion.late
        starts = np.arange(0, len(late), max(1, round(BLOCK_S / self._motion.period)))
        squares = np.zeros_like(late)
        squares[starts] = np.add.reduceat(late, starts, axis=0) ** 2
        return self._steps(squares)

    def missed(self) -> Steps:
        """Return the steps with the errors of gaps."""
        return self._steps(self._motion.filled, self._motion.unfilled)

    def rounded(self) -> Steps:
        """Return the steps with the rounding errors of feedback lines.

        The resolution of the encoders is not included.
        """
        found = self._rounding
        if found.count:
            return self._steps(missed=self._of_wheels(found.offset[1:]))
        roots = np.sqrt(found.variance[1:])
        variances = [
            np.einsum("ki,ij,kj->k", roots * row, found.alike, roots * row) for row in self._weights
        ]
        return self._steps(np.column_stack(variances))

    def contradicted(self) -> Steps:
        """Return the steps with the errors of wheels that contradict each other.

        If the front and the rear wheel of a side differ and one of them is right, the mean of both
        is wrong by half of the difference.
        """
        turned = np.diff([line.positions for line in self._lines], axis=0)
        front_right, front_left, rear_left, rear_right = turned.T
        right, left = (front_right - rear_right) / 2, (front_left - rear_left) / 2
        return self._steps(missed=self._of_wheels(np.column_stack([right, left, left, right])))

    def _of_wheels(self, off: Floats) -> Floats:
        """Return the missed motion for wheel angles that are wrong by exactly `off`, rad."""
        moved = off @ self._weights.T
        return np.hstack([moved, np.zeros_like(moved)])

    def _steps(
        self, variances: Floats | None = None, missed: Floats | None = None,
        gyro: Floats | None = None,
    ) -> Steps:  # fmt: skip
        """Return the steps with these errors. The arguments have one row for each feedback line."""
        moved, count = self._motion, len(self._motion.distance)
        errors = [
            np.zeros((count, width)) if given is None else given.reshape(count, width)
            for given, width in ((variances, 2), (missed, 4), (gyro, 1))
        ]
        if self._gyro:
            # The gyro determines the heading, so wheel errors do not affect it.
            errors[0] = errors[0] * (1, 0)
            errors[1] = errors[1] * (1, 0, 1, 0)
        rows = np.column_stack([moved.distance, moved.turn, *errors])
        starts = np.arange(0, count, self._each)
        return Steps(np.add.reduceat(rows, starts, axis=0), self._gyro)
