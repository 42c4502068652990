"""Measures the motion of a drive, and the errors of each step of this motion, from feedback lines.

Some errors of a step are independent of the errors of other steps. They are given as variances.
Other errors have the same sign in each step and add up. They are given as missed motion, which is
a distance and a turn by which the pose is wrong.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.error_budget.quantization_step import quantization_step
from acsard.calibration.log_table import Floats
from acsard.core.motion.error_model import SPEED_RESOLUTION
from acsard.core.motion.gap_filling import Gaps
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Twist, WheelSpeeds

Counts = npt.NDArray[np.int64]

UNDELAYED_LINES = 30
"""Number of consecutive feedback lines, of which at least one is assumed not to be delayed.

At 100 Hz, these lines take 0.3 s. A busy host delays the daemon for less than this time.
"""

LOST_LINE_PERIODS = 0.6
"""If the smallest delay among `UNDELAYED_LINES` lines grows by this number of line periods or more,
a line counts as lost."""

DELAY_GAIN = 0.05
"""Gain of the low-pass filter that follows the smallest delay among `UNDELAYED_LINES` lines.

This delay drifts because the period is at first known only to about 1 %.
"""

CLUSTERED, ALIKE_TIMES = 0.4, 0.25
"""Limits that decide whether the period of lines is their median or their mean interval.

An interval is near the median if it differs from the median by less than the fraction
`ALIKE_TIMES`. The period is the median if more than the fraction `CLUSTERED` of the intervals are
near the median. Otherwise the lines arrive in bursts, and the period is the mean.
"""


class LineTimes(Struct, frozen=True):
    """The delays of feedback lines, and the number of lines that were lost."""

    late: Floats
    """Delay of each line minus the median delay, s."""
    missing: Counts
    """Number of feedback lines that were lost just before each line."""
    period: float
    """Mean interval at which the board sends lines, s. Lost lines count as sent."""


# The board makes its lines at a fixed period, or as answers to the lines of the daemon, so the
# times of its lines form a grid. A line cannot arrive before the board made it. The line with the
# smallest delay among its neighbors therefore shows where the grid is. If even this line arrives a
# whole period later than expected, a line was lost.
def line_times(t: Floats, sent: Floats) -> LineTimes:
    """Estimate the delay of each feedback line, and the number of lines that were lost before it.

    The function makes two estimates. The first estimate assumes that the board sends its lines at a
    fixed period. The second estimate assumes that the board answers each line of the daemon. The
    function returns the estimate with the smaller delays. If the second estimate is not possible,
    the function returns the first one.

    Args:
        t: the stamp of each feedback line, s. At least 3 lines are needed.
        sent: the time at which the daemon sent each of its lines to the board, s.
    """
    even = _even(t)
    asked = _prompted_delays(t, sent)
    if asked is None or np.ptp(t) == 0.0:
        return even
    return min(even, asked, key=lambda estimate: float(np.mean(np.abs(estimate.late))))


def _even(t: Floats) -> LineTimes:
    """Estimate the delays for a board that sends its feedback lines at a fixed period."""
    steps = np.diff(t)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    alike = np.abs(steps - usual) < ALIKE_TIMES * usual
    period = usual if np.mean(alike) > CLUSTERED else mean
    missing = _missing((t - t[0]) / period if period > 0.0 else np.arange(len(t), dtype=float))
    number = np.arange(len(t)) + np.cumsum(missing)
    # Fit a straight line twice. The second fit leaves out stalls, which distort the first fit.
    among = np.ones(len(t), dtype=bool)
    for _ in range(2):
        slope, start = np.polyfit(number[among], t[among], 1)
        late = t - (start + slope * number)
        among = np.abs(late - np.median(late)) <= 3 * np.std(late) + 1e-9
    return LineTimes(late - np.median(late), missing, float(slope))


def _prompted_delays(t: Floats, sent: Floats) -> LineTimes | None:
    """Estimate how late the replies arrived, for a board that answers each line of the daemon.

    `sent` contains the times of the daemon's lines. Return None if the line of any reply is not in
    `sent`.
    """
    if len(sent) < 3 or sent[0] > t[0] or len(sent) < len(t) / 2:
        return None
    at = np.interp(t, sent, np.arange(len(sent)))
    missing = _missing(at)
    number = np.arange(len(t)) + np.cumsum(missing)
    first = int(np.floor(np.quantile(at - number, 0.05)))
    number = number + first
    if number[0] < 0 or number[-1] >= len(sent):
        return None
    late = t - sent[number]
    return LineTimes(late - np.median(late), missing, float(np.mean(np.diff(sent))))


def _missing(at: Floats) -> Counts:
    """Return the number of lines that were lost just before each feedback line.

    `at` contains the time of each line, as a number of line periods since an arbitrary moment.
    """
    count = len(at)
    ahead = at - np.arange(count)
    padded = np.concatenate([ahead, np.full(UNDELAYED_LINES, np.inf)])
    earliest = np.lib.stride_tricks.sliding_window_view(padded, UNDELAYED_LINES)[:count].min(axis=1)
    counts = np.zeros(count, dtype=np.int64)
    usual = float(earliest[0])
    for i, now in enumerate(earliest.tolist()):
        over = now - usual
        if over >= LOST_LINE_PERIODS:
            counts[i] = round(over)
            usual += round(over)
        else:
            usual += DELAY_GAIN * over
    return counts


BLOCK_S = 0.5
"""Length of the intervals in which the errors of stamps are correlated, s.

The errors are correlated because one stall of the computer delays all lines that arrive during it.
"""

LEAST_LINES, ALIKE = 20, 0.99
"""Limits for the fit that separates the noise of the gyro from its scale error.

`LEAST_LINES` is the minimum number of lines while the robot moves. If the turns are nearly
proportional to time (cosine above `ALIKE`), the fit cannot separate noise and scale error.
"""

MAX_DELAY_S = 0.1
"""Largest delay of a feedback line, s, that counts as an error of its stamp.

It is also the shortest gap in the feedback. A gap is an interval between two lines in which the
wheel positions did not change although the later line reports a speed.
"""

Wheels = tuple[float, float, float, float]
"""Numbers for the four wheels, in the order of `acsard.core.values.WHEELS`."""


class Line(Struct, frozen=True):
    """A feedback line of the board, and the heading that the odometry computed with it."""

    at: float
    """Stamp of the line, s since the start of the measurement."""
    speeds: Wheels
    """Wheel speeds, rad/s."""
    positions: Wheels
    """Angles that the wheels have rolled since the daemon started, rad."""
    yaw: float
    """Heading, rad."""
    yaw_variance: float
    """Variance of the heading, rad2."""


class Motion(Struct, frozen=True):
    """The motion from each feedback line to the next line, and its errors.

    Each array has one row for each interval between two successive lines.
    """

    seconds: float
    period: float
    """Mean interval at which the board sends lines, s. Lost lines count as sent."""
    distance: Floats
    """Distance from each line to the next, m, negative backwards."""
    turn: Floats
    """Turn from each line to the next, rad, positive to the left."""
    yaw_variance: Floats | None
    """Variance that the noise of the gyro adds to each turn, rad2; None if it is unknown."""
    late: Floats
    """Errors of distance and turn due to wrong stamps of lines: rows of (m, rad)."""
    lateness: float
    """RMS error of the time stamps of feedback lines, s."""
    filled: Floats
    """Errors of the motion that the odometry assumed for lost lines: variances (m2, rad2).

    The rows without lost lines are 0.
    """
    unfilled: Floats
    """Motion that the pose missed in each gap, and its variances: rows of (m, rad, m2, rad2).

    The rows without a gap are 0.
    """
    missing: int
    """Number of feedback lines that were lost during the drive."""
    unseen: float
    """Total duration of the gaps in the feedback, s."""


def motion(
    lines: list[Line],
    sent: Floats,
    kinematics: Kinematics,
    whole: bool,
    gyro_scale_std: float = 0.0,
) -> Motion:
    """Compute the motion between at least 3 feedback lines, and the errors of this motion.

    Args:
        lines: the feedback lines in order.
        sent: the time at which the daemon sent each of its lines to the board, s.
        kinematics: the geometry of the robot.
        whole: whether this program received every feedback line that the daemon received. If it is
            false, a line that is missing here may have reached the daemon. Such a line counts as
            lost only if the odometry of the daemon has a gap too.
        gyro_scale_std: relative standard deviation of the gyro's scale; 0 without a gyro.
    """
    t = np.array([line.at for line in lines])
    times = line_times(t, sent)
    twists = [kinematics.twist(WheelSpeeds(*line.speeds)) for line in lines]
    rolled = [
        kinematics.twist(WheelSpeeds(*np.subtract(b.positions, a.positions).tolist()))
        for a, b in pairwise(lines)
    ]
    turns = [math.remainder(b.yaw - a.yaw, math.tau) for a, b in pairwise(lines)]
    growth = _noise(
        t, np.array([line.speeds for line in lines]), np.array(turns),
        np.array([line.yaw_variance for line in lines]), gyro_scale_std,
    )  # fmt: skip
    filled, unfilled, missing, unseen = _gaps(t, twists, rolled, times, whole)
    late = _late(t, twists, times)
    late[unfilled.any(axis=1)] = 0.0
    return Motion(
        float(t[-1] - t[0]), times.period, np.array([twist.linear for twist in rolled]),
        np.array(turns), growth, late, float(np.sqrt(np.mean(times.late**2))), filled,
        unfilled, missing, unseen,
    )  # fmt: skip


def _noise(
    t: Floats, speeds: Floats, turns: Floats, variances: Floats, scale_std: float
) -> Floats | None:
    """Return the variance, rad2, that the gyro's noise adds to the heading between two lines.

    Return None if the noise cannot be separated from the gyro's scale error. `variances` contains
    the variance of the heading at each line, rad2. `scale_std` is the relative standard deviation
    of the gyro's scale.
    """
    # The gyro's scale error also adds to the variance of the heading: S^2 A^2, where S is
    # `scale_std`, and A is the turn since the pose was last set. A further turn dA adds
    # 2 S^2 A dA. A is unknown at the first line, so a least-squares fit estimates A and the noise
    # together.
    #
    # Leave out the lines in which the variance falls, because the pose was set there.
    dt, moves = np.diff(t), speeds[1:].any(axis=1) & (variances[1:] > variances[:-1] / 2)
    levers, before = 2 * scale_std**2 * turns, np.cumsum(turns) - turns / 2
    grown = np.diff(variances) - levers * before
    columns = np.column_stack((dt, levers))[moves]
    sizes = np.sqrt(np.sum(columns**2, axis=0))
    if len(columns) < LEAST_LINES or not sizes[0]:
        return None
    if sizes[1] and abs(columns[:, 0] @ columns[:, 1]) > ALIKE * sizes[0] * sizes[1]:
        return None
    used = columns / np.where(sizes > 0.0, sizes, 1.0)
    rate = float(np.linalg.lstsq(used, grown[moves], rcond=None)[0][0]) / float(sizes[0])
    return np.where(moves, max(0.0, rate) * dt, 0.0)


def _late(t: Floats, twists: list[Twist], times: LineTimes) -> Floats:
    # A wrong stamp changes the interval dt before a line, and thus the distance, which is speed
    # times dt. It changes the next interval by the opposite amount. Summation by parts gives each
    # line one error: the delay of the line times (speed in this line - speed in the next line).
    speeds = np.array([(twist.linear, twist.angular) for twist in twists])
    near = np.abs(times.late) <= MAX_DELAY_S
    # A constant delay causes no error, so subtract the mean delay.
    late = np.where(near, times.late - times.late[near].mean(), 0.0)
    parts = np.zeros((len(t) - 1, 2))
    parts[:-1] = -late[1:-1, None] * np.diff(speeds[1:], axis=0)
    return parts


def _gaps(
    t: Floats, twists: list[Twist], rolled: list[Twist], times: LineTimes, whole: bool
) -> tuple[Floats, Floats, int, float]:
    """Compute the errors that lost feedback lines cause.

    The results are the fields `filled`, `unfilled`, `missing` and `unseen` of `Motion`.

    Args:
        t: the stamp of each line, s.
        twists: the twist of the robot at each line, computed from the wheel speeds.
        rolled: the motion of the robot from each line to the next, computed from the wheel
            positions.
        times: the delays of the lines, and the number of lost lines.
        whole: whether this program received every line that the daemon received. If it is false,
            a lost line counts only in a gap that the odometry of the daemon did not fill.
    """
    filled, unfilled = np.zeros((len(rolled), 2)), np.zeros((len(rolled), 4))
    lost, unseen = 0, 0.0
    gaps = Gaps()
    gaps.interrupt(twists[0])
    for k, (moved, missing) in enumerate(zip(rolled, times.missing[1:].tolist(), strict=True)):
        before, after, dt = twists[k], twists[k + 1], float(t[k + 1] - t[k])
        mean = Twist((before.linear + after.linear) / 2, (before.angular + after.angular) / 2)
        moves = moved != Twist() or after == Twist()
        if not moves and dt >= MAX_DELAY_S:
            unseen += dt
            lost += missing
            along, yaw = gaps.unseen(dt, before, after)
            unfilled[k] = dt * mean.linear, dt * mean.angular, along, yaw
            gaps.interrupt(after)
        elif missing and whole:
            seconds = missing * times.period
            unseen += seconds
            lost += missing
            # The odometry may have filled the gap with another motion than the motion at the mean
            # of the speeds before and after the gap.
            off = moved.linear - after.linear * times.period - mean.linear * seconds
            turned = moved.angular - after.angular * times.period - mean.angular * seconds
            along, yaw = gaps.unseen(seconds, before, after)
            filled[k] = along + off * off, yaw + turned * turned
            gaps.interrupt(after)
        else:
            gaps.follow(after, times.period)
    return filled, unfilled, lost, unseen


EQUAL_SPEEDS_FRACTION = 0.8
"""If two wheels report equal speeds in at least this fraction of the lines, their rounding errors
are assumed to be equal."""

MIN_VALUES = 3
"""Minimum number of different speeds from which a quantization step is computed."""


# A feedback line carries wheel speeds with two decimals. Independent rounding errors have a
# standard deviation of q / sqrt(12), where q is the quantization step. A wheel at a constant speed
# repeats the same error, so n equal values in a row make one error of n times this size. If a wheel
# passes through a value while it becomes faster or slower, the errors before and after the middle
# of the equal values cancel.
#
# Some firmware counts encoder edges in each period, and reports multiples of the speed of one count
# per period. An edge that comes too late for one period is counted in the next period, so errors of
# the count do not accumulate. The errors from rounding the multiples to two decimals do accumulate,
# but they can be computed.
class RoundingErrors(Struct, frozen=True):
    """The errors that the rounding of wheel speeds in feedback lines causes.

    `variance` and `offset` have a row for each feedback line and the columns of `values.WHEELS`.
    """

    variance: Floats
    """Variance of the error of the angle that a wheel rolled since the previous line, rad2."""
    offset: Floats
    """Computed error of the angle that a wheel rolled since the previous line, rad."""
    equal_errors: Floats
    """Matrix of pairs of wheels, shape (4, 4).

    An element is 1 if the two wheels have equal rounding errors, and 0 otherwise.
    """
    quantum: float
    """Quantization step of the wheel speeds, rad/s."""
    count: float
    """Angle by which a wheel turns in one encoder count, rad; 0 if the lines do not show it."""


def rounding(speeds: Floats, period: float) -> RoundingErrors:
    """Estimate the errors that the rounding of wheel speeds causes.

    `speeds`, rad/s, has a row for each feedback line and a column for each wheel. `period` is the
    time between two lines, s.
    """
    moving = np.any(speeds != 0.0, axis=1)
    same = speeds[moving][:, :, None] == speeds[moving][:, None, :]
    equal_errors = (
        (same.mean(axis=0) >= EQUAL_SPEEDS_FRACTION).astype(float) if moving.any() else np.eye(4)
    )
    quantum = _quantum(speeds)
    if quantum:
        off = (speeds - quantum * np.round(speeds / quantum)) * period
        return RoundingErrors(np.zeros_like(speeds), off, equal_errors, quantum, quantum * period)
    variance = np.column_stack([_runs(column) for column in speeds.T])
    scale = (SPEED_RESOLUTION * period) ** 2 / 12
    return RoundingErrors(
        variance * scale, np.zeros_like(speeds), equal_errors, SPEED_RESOLUTION, 0.0
    )


def _runs(values: Floats) -> Floats:
    """Return the variance of each line's rounding error, relative to (quantization step)^2 / 12.

    The result differs from 1 because successive equal speeds have the same error, which adds up.
    """
    # Of n equal speeds in a row, the last one has the variance n^2, and the others have 0. If the
    # wheel passed through this speed while it became faster or slower, the last one has the
    # variance 1.
    variances = np.zeros(len(values))
    ends = np.append(np.flatnonzero(np.diff(values)), len(values) - 1)
    starts = np.append(0, ends[:-1] + 1)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if values[start] == 0.0:
            continue  # the wheel stands still
        length = end - start + 1
        if start > 0 and end + 1 < len(values):
            before, after = values[start - 1] - values[start], values[end + 1] - values[start]
            length = 1 if before * after < 0.0 else length
        variances[end] = length**2
    return variances


def _quantum(speeds: Floats) -> float:
    # Count each value once, because its repetitions do not add evidence.
    sizes = np.unique(np.abs(speeds[speeds != 0.0]))
    return quantization_step(sizes) if len(sizes) >= MIN_VALUES else 0.0


class DriveSteps(Struct, frozen=True):
    """A drive, divided into short steps, with the errors that one cause makes in each step."""

    rows: Floats
    """One row for each step, with nine columns:

    - 0, 1: distance (m) and turn (rad) of the step
    - 2, 3: variances of distance and turn (m2, rad2), independent of other steps
    - 4, 5: motion that the pose missed (m, rad), with the same sign in each step
    - 6, 7: variances of the missed motion (m2, rad2)
    - 8: variance of the turn if a gyro measured it (rad2)
    """
    by_gyro: bool = False
    """True if a gyro measured the turns, and false if the wheels did."""

    def to_the_left(self) -> DriveSteps:
        """Return the steps with each right turn mirrored, so that all turns are to the left."""
        rows = self.rows.copy()
        rows[rows[:, 1] < 0.0] *= (1, -1, 1, 1, 1, -1, 1, 1, 1)
        return DriveSteps(rows, self.by_gyro)


class Driving:
    """A measured drive, from which the errors of each cause are computed.

    The drive is divided into steps of about `step_s` s. Most methods return all steps, with the
    errors of one cause. `gyro` is true if a gyro measured the turns.
    """

    def __init__(
        self, lines: list[Line], motion: Motion, rounding: RoundingErrors, kinematics: Kinematics,
        step_s: float, gyro: bool,
    ) -> None:  # fmt: skip
        self._lines, self._motion, self._rounding, self._gyro = lines, motion, rounding, gyro
        self._lines_per_step = max(1, round(step_s / motion.period))
        twists = [kinematics.twist(WheelSpeeds(*row)) for row in np.eye(4).tolist()]
        self._weights = np.array([[t.linear for t in twists], [t.angular for t in twists]])
        """Motion of the robot if only one wheel rolls, by 1 rad, with a column for each wheel.

        Row 0 contains the distance, m, and row 1 the turn, rad.
        """

    def plain(self) -> DriveSteps:
        """Return the steps without errors."""
        return self._steps()

    @property
    def tells_gyro(self) -> bool:
        """True if the variance of the published heading shows how large the gyro's noise is."""
        return self._motion.yaw_variance is not None

    def turned_by_gyro(self) -> DriveSteps:
        """Return the steps with the noise that the odometry assumes for the gyro."""
        return self._steps(gyro=self._motion.yaw_variance)

    def late(self) -> DriveSteps:
        """Return the steps with the errors that wrong stamps of feedback lines cause."""
        late = self._motion.late
        starts = np.arange(0, len(late), max(1, round(BLOCK_S / self._motion.period)))
        squares = np.zeros_like(late)
        squares[starts] = np.add.reduceat(late, starts, axis=0) ** 2
        return self._steps(squares)

    def missed(self) -> DriveSteps:
        """Return the steps with the errors that gaps in the feedback cause."""
        return self._steps(self._motion.filled, self._motion.unfilled)

    def rounded(self) -> DriveSteps:
        """Return the steps with the errors that the rounding of reported speeds causes."""
        errors = self._rounding
        if errors.count:
            return self._steps(missed=self._of_wheels(errors.offset[1:]))
        roots = np.sqrt(errors.variance[1:])
        variances = [
            np.einsum("ki,ij,kj->k", roots * row, errors.equal_errors, roots * row)
            for row in self._weights
        ]
        return self._steps(np.column_stack(variances))

    def contradicted(self) -> DriveSteps:
        """Return the steps with the errors of wheels that contradict each other.

        On each side of the robot, the computation assumes that either the front or the rear wheel
        has no error. The mean of both wheels is then wrong by half of their difference.
        """
        turned = np.diff([line.positions for line in self._lines], axis=0)
        front_right, front_left, rear_left, rear_right = turned.T
        right, left = (front_right - rear_right) / 2, (front_left - rear_left) / 2
        return self._steps(missed=self._of_wheels(np.column_stack([right, left, left, right])))

    def _of_wheels(self, off: Floats) -> Floats:
        """Convert errors of the wheels' angles to errors of the motion: rows of (m, rad, 0, 0).

        `off` contains the errors of the angles by which the wheels rolled, rad.
        """
        moved = off @ self._weights.T
        return np.hstack([moved, np.zeros_like(moved)])

    def _steps(
        self, variances: Floats | None = None, missed: Floats | None = None,
        gyro: Floats | None = None,
    ) -> DriveSteps:  # fmt: skip
        moved, count = self._motion, len(self._motion.distance)
        errors = [
            np.zeros((count, width)) if error is None else error.reshape(count, width)
            for error, width in ((variances, 2), (missed, 4), (gyro, 1))
        ]
        if self._gyro:
            # The gyro determines the heading, so wheel errors do not affect it.
            errors[0] = errors[0] * (1, 0)
            errors[1] = errors[1] * (1, 0, 1, 0)
        rows = np.column_stack([moved.distance, moved.turn, *errors])
        starts = np.arange(0, count, self._lines_per_step)
        return DriveSteps(np.add.reduceat(rows, starts, axis=0), self._gyro)
