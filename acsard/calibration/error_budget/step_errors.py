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
"""Share of lines with equal values from which two wheels are assumed to have the same error."""


LEAST_VALUES = 3
"""Distinct speeds that are needed to find a quantization step. One or two prove nothing."""


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
    quantum = _quantum(speeds)
    if quantum:
        off = (speeds - quantum * np.round(speeds / quantum)) * period
        return Rounding(np.zeros_like(speeds), off, alike, quantum, quantum * period)
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


def _quantum(speeds: Floats) -> float:
    """Return the speed in rad/s of which all speeds are multiples, or 0 if there is none."""
    # A value that is held for a whole drive is no more evidence than one line of it.
    seen = np.unique(np.abs(speeds[speeds != 0.0])).tolist()
    if len(seen) < LEAST_VALUES:
        return 0.0
    search = Search(dict.fromkeys(seen, 1))
    while not search.go_on():
        pass
    return search.found.quantum if search.found is not None else 0.0


class Steps(Struct, frozen=True):
    """The steps of a drive with the errors of one cause.

    A row has the distance in m and the turn in rad; the variances (m2, rad2) that are independent
    of other steps; the motion that the pose missed in each step in the same sense (m, rad) with its
    variances (m2, rad2); and the variance (rad2) of a turn that a gyro measured.
    """

    rows: Floats
    by_gyro: bool = False
    """Whether a gyro measured the turns. Otherwise the wheels did."""

    def to_the_left(self) -> Steps:
        """Return the steps with every turn to the left, and its errors as well."""
        rows = self.rows.copy()
        rows[rows[:, 1] < 0.0] *= (1, -1, 1, 1, 1, -1, 1, 1, 1)
        return Steps(rows, self.by_gyro)


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

    def plain(self) -> Steps:
        """Return the steps without an error."""
        return self._steps()

    @property
    def tells_gyro(self) -> bool:
        """Whether the lines show the noise of the gyro."""
        return self._motion.yaw_variance is not None

    def turned_by_gyro(self) -> Steps:
        """Return the steps with the gyro noise that odometry assumes."""
        return self._steps(gyro=self._motion.yaw_variance)

    def late(self) -> Steps:
        """Return the steps with the errors of late lines.

        Correlated errors are summed before they are squared.
        """
        late = self._motion.late
        starts = np.arange(0, len(late), max(1, round(BLOCK_S / self._motion.period)))
        squares = np.zeros_like(late)
        squares[starts] = np.add.reduceat(late, starts, axis=0) ** 2
        return self._steps(squares)

    def missed(self) -> Steps:
        """Return the steps with the errors of gaps."""
        return self._steps(self._motion.bridged, self._motion.stood)

    def rounded(self) -> Steps:
        """Return the steps with the rounding errors of lines.

        An encoder's own resolution is not included.
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
        """Return the steps with the errors that contradicting wheels imply.

        If the front and the rear wheel of a side disagree and one is right, their mean is off by
        half the difference.
        """
        turned = np.diff([line.positions for line in self._lines], axis=0)
        front_right, front_left, rear_left, rear_right = turned.T
        right, left = (front_right - rear_right) / 2, (front_left - rear_left) / 2
        return self._steps(missed=self._of_wheels(np.column_stack([right, left, left, right])))

    def _of_wheels(self, off: Floats) -> Floats:
        """Return the motion that the pose missed by angles of the wheels, which are certain."""
        moved = off @ self._weights.T
        return np.hstack([moved, np.zeros_like(moved)])

    def _steps(
        self, variances: Floats | None = None, missed: Floats | None = None,
        gyro: Floats | None = None,
    ) -> Steps:  # fmt: skip
        """Sum the lines' errors into steps; the arguments have one row for each line."""
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
