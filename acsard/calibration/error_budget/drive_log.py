"""Computes the motion of a drive and its measured errors from feedback lines.

Two of the errors are late stamps and lost lines. To find them, the times at which the board made
its lines are estimated. The board makes a line at a fixed period, or as the answer to each line of
the daemon, so these times form a grid. A line cannot arrive before it was made. The line with the
smallest delay among its neighbours therefore shows where the grid is. If even this line comes a
whole period later than expected, a line was lost. The difference between a stamp and its time on
the grid is the error of the stamp.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.core.motion.gap_filling import Gaps
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.uncertainty import GYRO_SCALE
from acsard.core.values import Twist, WheelSpeeds

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

AHEAD = 30
"""Number of consecutive lines of which at least one is not delayed.

It is the number of lines in 0.3 s, the longest time for which a host stalls.
"""

MISSING = 0.6
"""Delay of the earliest line, in periods, from which a line was lost."""

FOLLOWED = 0.05
"""Part of a new delay by which the grid is corrected. At first the period is known to about 1 %."""

CLUSTERED, ALIKE_TIMES = 0.4, 0.25
"""Criterion for lines that arrive one by one, not in bursts.

More than the fraction `CLUSTERED` of the intervals differ from their median by less than the
fraction `ALIKE_TIMES`.
"""


class LineTimes(Struct, frozen=True):
    """Estimates of the delay of each feedback line and of the lines that were lost."""

    late: Floats
    """Delay of each line minus the median delay, s."""
    missing: Counts
    """Number of lines that were lost before each line."""
    period: float
    """Mean interval between two lines, s."""


def line_times(t: Floats, sent: Floats) -> LineTimes:
    """Estimate the delays of feedback lines.

    Both kinds of boards are tried, and the estimate with the smaller delays is returned.

    Args:
        t: the stamps of at least 3 feedback lines, s.
        sent: the times at which the daemon sent lines, s.
    """
    even = _even(t)
    asked = _asked(t, sent)
    if asked is None or np.ptp(t) == 0.0:
        return even
    return min(even, asked, key=lambda found: float(np.mean(np.abs(found.late))))


def _even(t: Floats) -> LineTimes:
    """Estimate the delays of the lines of a board that sends at a fixed period."""
    steps = np.diff(t)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    alike = np.abs(steps - usual) < ALIKE_TIMES * usual
    period = usual if np.mean(alike) > CLUSTERED else mean
    missing = _missing((t - t[0]) / period if period > 0.0 else np.arange(len(t), dtype=float))
    number = np.arange(len(t)) + np.cumsum(missing)
    # Fit a straight line twice. The second fit leaves out the stalls, which distort the first one.
    among = np.ones(len(t), dtype=bool)
    for _ in range(2):
        slope, start = np.polyfit(number[among], t[among], 1)
        late = t - (start + slope * number)
        among = np.abs(late - np.median(late)) <= 3 * np.std(late) + 1e-9
    return LineTimes(late - np.median(late), missing, float(slope))


def _asked(t: Floats, sent: Floats) -> LineTimes | None:
    """Estimate the delays of the lines of a board that answers each line of the daemon.

    Returns None if too few lines of the daemon are known.
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
    """Return the number of lines that were lost before each line.

    `at` has the number of periods from the first line to the stamp of each line.
    """
    count = len(at)
    ahead = at - np.arange(count)
    padded = np.concatenate([ahead, np.full(AHEAD, np.inf)])
    earliest = np.lib.stride_tricks.sliding_window_view(padded, AHEAD)[:count].min(axis=1)
    found = np.zeros(count, dtype=np.int64)
    usual = float(earliest[0])
    for i, now in enumerate(earliest.tolist()):
        over = now - usual
        if over >= MISSING:
            found[i] = round(over)
            usual += round(over)
        else:
            usual += FOLLOWED * over
    return found


BLOCK_S = 0.5
"""Time within which errors of stamps are correlated, s. It exceeds the longest stall of a host."""

LEAST_LINES, ALIKE = 20, 0.99
"""Limits for the fit of the gyro's noise: the smallest number of lines while the robot moves, and
the cosine of turn and time above which the fit cannot separate them."""

LATEST_S = 0.1
"""Delay in s from which a stamp says nothing about when the line was made.

The motion of such a line is treated as a gap.
"""

Wheels = tuple[float, float, float, float]
"""Values of the four wheels, in the order of `values.WHEELS`."""


class Line(Struct, frozen=True):
    """A feedback line and the odometry computed from it."""

    at: float
    """Stamp, s since the start."""
    speeds: Wheels
    """Wheel speeds, rad/s."""
    positions: Wheels
    """Wheel angles since the start of the daemon, rad."""
    yaw: float
    """Heading, rad."""
    yaw_variance: float
    """Variance of the heading, rad2."""


class Motion(Struct, frozen=True):
    """The motion between consecutive feedback lines, and its errors.

    An array has one entry for each line except the first.
    """

    seconds: float
    """Duration of the drive, s."""
    period: float
    """Mean interval between two lines, s."""
    distance: Floats
    """Signed distance, m."""
    turn: Floats
    """Turn, rad."""
    yaw_variance: Floats | None
    """Variance that odometry added to the heading with time, rad2; None if it is unknown."""
    late: Floats
    """Errors because of wrong stamps, rows of (m, rad)."""
    lateness: float
    """RMS error of the stamps, s."""
    filled: Floats
    """Variances of gaps that odometry filled, rows of (m2, rad2). Other rows are zero."""
    unfilled: Floats
    """Motion in gaps that odometry did not fill, and its variances, rows of (m, rad, m2, rad2).

    The pose did not move in such a gap. Other rows are zero.
    """
    missing: int
    """Number of lines that were lost."""
    unseen: float
    """Total duration of the gaps, s."""


def motion(lines: list[Line], sent: Floats, kinematics: Kinematics, whole: bool) -> Motion:
    """Compute the motion of a drive and its errors.

    Args:
        lines: at least 3 feedback lines.
        sent: the times at which the daemon sent lines to the microcontroller, s.
        kinematics: the geometry of the robot.
        whole: whether every line of the daemon arrived here. If not, a missing line may have been
            lost between the daemon and this program, so it does not count as lost.
    """
    t = np.array([line.at for line in lines])
    found = line_times(t, sent)
    twists = [kinematics.twist(WheelSpeeds(*line.speeds)) for line in lines]
    rolled = [
        kinematics.twist(WheelSpeeds(*np.subtract(b.positions, a.positions).tolist()))
        for a, b in pairwise(lines)
    ]
    turns = [math.remainder(b.yaw - a.yaw, math.tau) for a, b in pairwise(lines)]
    growth = _noise(
        t, np.array([line.speeds for line in lines]), np.array(turns),
        np.array([line.yaw_variance for line in lines]),
    )  # fmt: skip
    seen = _Gaps(t, twists, rolled, found, whole)
    late = _late(t, twists, found)
    late[seen.unfilled.any(axis=1)] = 0.0
    return Motion(
        float(t[-1] - t[0]), found.period, np.array([one.linear for one in rolled]),
        np.array(turns), growth, late, float(np.sqrt(np.mean(found.late**2))), seen.filled,
        seen.unfilled, seen.missing, seen.unseen,
    )  # fmt: skip


def _noise(t: Floats, speeds: Floats, turns: Floats, variances: Floats) -> Floats | None:
    """Return the growth of the heading's variance with time in each line, rad2.

    It is 0 in lines in which the wheels do not turn. The variance of the heading also contains the
    scale error of the gyro, S^2 A^2. S is the relative standard deviation of the scale, and A is
    the turn since the pose was set. A line with the turn dA adds 2 S^2 A dA, which is subtracted
    here. The turn before the first line is unknown, so a least-squares fit estimates it together
    with the rate of growth. Returns None if the fit cannot separate turn and time.
    """
    # Leave out the lines in which the variance falls, because the pose was set there.
    dt, moves = np.diff(t), speeds[1:].any(axis=1) & (variances[1:] > variances[:-1] / 2)
    levers, before = 2 * GYRO_SCALE**2 * turns, np.cumsum(turns) - turns / 2
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


def _late(t: Floats, twists: list[Twist], found: LineTimes) -> Floats:
    """Return the errors of the motion because of wrong stamps, rows of (m, rad).

    A wrong stamp changes the interval dt of a line, and so the distance, which is speed times dt.
    Summation by parts turns the sum of these errors into terms of one line each: minus the delay of
    the line times the change of the speed after it.
    """
    speeds = np.array([(one.linear, one.angular) for one in twists])
    near = np.abs(found.late) <= LATEST_S
    # A constant delay causes no error, so subtract the mean delay.
    late = np.where(near, found.late - found.late[near].mean(), 0.0)
    parts = np.zeros((len(t) - 1, 2))
    parts[:-1] = -late[1:-1, None] * np.diff(speeds[1:], axis=0)
    return parts


class _Gaps:
    """The errors of the gaps of a drive, by the odometry's own model of unseen motion."""

    def __init__(
        self, t: Floats, twists: list[Twist], rolled: list[Twist], found: LineTimes, whole: bool
    ) -> None:
        self.filled = np.zeros((len(rolled), 2))
        self.unfilled = np.zeros((len(rolled), 4))
        self.missing, self.unseen = 0, 0.0
        gaps = Gaps()
        gaps.interrupt(twists[0])
        for k, (moved, missing) in enumerate(zip(rolled, found.missing[1:].tolist(), strict=True)):
            before, after, dt = twists[k], twists[k + 1], float(t[k + 1] - t[k])
            mean = Twist((before.linear + after.linear) / 2, (before.angular + after.angular) / 2)
            moves = moved != Twist() or after == Twist()
            if not moves and dt >= LATEST_S:
                self.unseen += dt
                self.missing += missing
                along, yaw = gaps.unseen(dt, before, after)
                self.unfilled[k] = dt * mean.linear, dt * mean.angular, along, yaw
                gaps.interrupt(after)
            elif missing and whole:
                self.unseen += missing * found.period
                self.missing += missing
                self.filled[k] = _filled_variances(
                    missing * found.period, moved, before, after, mean, found.period, gaps
                )
                gaps.interrupt(after)
            else:
                gaps.follow(after, found.period)


def _filled_variances(
    seconds: float, moved: Twist, before: Twist, after: Twist, mean: Twist, period: float,
    gaps: Gaps,
) -> tuple[float, float]:  # fmt: skip
    """Return the variances (m2, rad2) of a gap that odometry filled.

    They are the model's variances for unseen motion, plus the squared difference between the motion
    that odometry filled in and the motion at the mean of the speeds before and after the gap.
    """
    along, yaw = gaps.unseen(seconds, before, after)
    off = moved.linear - after.linear * period - mean.linear * seconds
    turned = moved.angular - after.angular * period - mean.angular * seconds
    return along + off * off, yaw + turned * turned
