"""A drive and its measured errors, reconstructed from feedback lines for the error budget.

One of the errors is how late the stamp of each line is, and how many lines are missing before it. A
microcontroller sends its lines either at a fixed period or as answers to the host's lines. A line
cannot arrive before it was made. So the earliest line among its neighbours, relative to the
expected grid, shows where the grid is. If even the earliest one is a whole place later, a line is
missing. The remaining difference between a line's stamp and its place on the grid is the error of
its time.
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
"""Number of lines of which at least one is not delayed; the longest stall of a host is 0.3 s."""

MISSING = 0.6
"""Delay of the earliest line, in places, from which a line counts as missing."""

FOLLOWED = 0.05
"""Share of a new delay that corrects the grid, because the period is known to about 1 % at
first."""

CLUSTERED, ALIKE_TIMES = 0.4, 0.25
"""Criterion for lines that arrive one by one: this share of the intervals is close to the median,
within this relative tolerance."""


class Places(Struct, frozen=True):
    """Estimates for each line.

    `late` is its delay in s relative to the median, and `missing` the number of lines missing
    before it.
    """

    late: Floats
    missing: Counts
    period: float
    """Mean interval between two lines, s."""


def places(t: Floats, sent: Floats) -> Places:
    """Estimate the delays of at least 3 lines with stamps `t` (s).

    `sent` holds the times (s) of the host's lines. Both ways to send lines are tried, and the one
    with the smaller errors is returned.
    """
    even = _even(t)
    asked = _asked(t, sent)
    if asked is None or np.ptp(t) == 0.0:
        return even
    return min(even, asked, key=lambda found: float(np.mean(np.abs(found.late))))


def _even(t: Floats) -> Places:
    """Estimate the delays of lines with a fixed period."""
    steps = np.diff(t)
    usual, mean = float(np.median(steps)), float(np.mean(steps))
    alike = np.abs(steps - usual) < ALIKE_TIMES * usual
    period = usual if np.mean(alike) > CLUSTERED else mean
    missing = _missing((t - t[0]) / period if period > 0.0 else np.arange(len(t), dtype=float))
    number = np.arange(len(t)) + np.cumsum(missing)
    # Fit twice: the second fit leaves out stalls that distorted the first line.
    among = np.ones(len(t), dtype=bool)
    for _ in range(2):
        slope, start = np.polyfit(number[among], t[among], 1)
        late = t - (start + slope * number)
        among = np.abs(late - np.median(late)) <= 3 * np.std(late) + 1e-9
    return Places(late - np.median(late), missing, float(slope))


def _asked(t: Floats, sent: Floats) -> Places | None:
    """Estimate the delays of lines that answer the host's lines; None if those are unknown."""
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
    return Places(late - np.median(late), missing, float(np.mean(np.diff(sent))))


def _missing(at: Floats) -> Counts:
    """Return the number of missing lines before each line.

    `at` is the place on the grid that each line's stamp suggests.
    """
    count = len(at)
    ahead = at - np.arange(count)
    padded = np.concatenate([ahead, np.full(AHEAD, np.inf)])
    promptest = np.lib.stride_tricks.sliding_window_view(padded, AHEAD)[:count].min(axis=1)
    found = np.zeros(count, dtype=np.int64)
    usual = float(promptest[0])
    for i, now in enumerate(promptest.tolist()):
        over = now - usual
        if over >= MISSING:
            found[i] = round(over)
            usual += round(over)
        else:
            usual += FOLLOWED * over
    return found


BLOCK_S = 0.5
"""Time over which errors of line times are correlated; the longest stall of a host is 0.3 s."""

LEAST_LINES, ALIKE = 20, 0.99
"""Limits for the fit of the gyro's noise: minimum number of moving lines, and the cosine from which
turn and time cannot be told apart."""

LATEST_S = 0.1
"""Lateness in s from which a stamp shows only when the line was read. Its motion is then treated as
a gap."""

Wheels = tuple[float, float, float, float]


class Line(Struct, frozen=True):
    """A feedback line and the odometry computed from it."""

    at: float
    """Stamp, s since the start."""
    speeds: Wheels
    """Wheel speeds, rad/s."""
    positions: Wheels
    """Wheel positions, rad."""
    yaw: float
    """Heading, rad."""
    yaw_variance: float
    """Variance of the heading, rad2."""


class Motion(Struct, frozen=True):
    """Motion between consecutive lines and its errors.

    The arrays have one entry per line but the first.
    """

    seconds: float
    """Duration of the drive, s."""
    period: float
    distance: Floats
    """Signed distance, m."""
    turn: Floats
    """Turn, rad."""
    yaw_variance: Floats | None
    """Variance that odometry added to the heading with time, rad2; None if it cannot be
    determined."""
    late: Floats
    """Errors due to wrong line times, rows of (m, rad)."""
    lateness: float
    """RMS error of the line times, s."""
    bridged: Floats
    """Variances due to missing lines across which odometry continued the pose, rows of (m2,
    rad2)."""
    stood: Floats
    """Motion across gaps in which odometry did not move the pose, rows of (m, rad, m2, rad2): the
    estimated motion and its variances. A row is zero without such a gap before its line."""
    missing: int
    unseen: float
    """Total duration of the gaps, s."""


def motion(lines: list[Line], sent: Floats, kinematics: Kinematics, whole: bool) -> Motion:
    """Compute the motion of at least 3 lines.

    `sent` holds the times (s) at which lines were sent to the microcontroller. If `whole` is False,
    lines may have been lost on the way to this program, so a missing line is not counted as missed
    by the daemon.
    """
    t = np.array([line.at for line in lines])
    found = places(t, sent)
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
    late[seen.stood.any(axis=1)] = 0.0
    return Motion(
        float(t[-1] - t[0]), found.period, np.array([one.linear for one in rolled]),
        np.array(turns), growth, late, float(np.sqrt(np.mean(found.late**2))), seen.bridged,
        seen.stood, seen.missing, seen.unseen,
    )  # fmt: skip


def _noise(t: Floats, speeds: Floats, turns: Floats, variances: Floats) -> Floats | None:
    """Return the growth of the heading's variance with time alone in each line while wheels turn,
    rad2.

    The variance also contains the scale error of the gyro, S^2 A^2, where S is the relative
    standard deviation of the scale and A the turn since the pose was set. A line with the turn dA
    adds 2 S^2 A dA. The part of A from before the first line is unknown, so a least-squares fit
    estimates it together with the rate, and discards it. Returns None if turn and time cannot be
    told apart.
    """
    # The variance falls when the pose is set; such lines are left out.
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


def _late(t: Floats, twists: list[Twist], found: Places) -> Floats:
    """Return the errors of each line's motion: the sum of speed times time error, rearranged.

    By summation by parts, each line contributes minus its lateness times the following change of
    speed.
    """
    speeds = np.array([(one.linear, one.angular) for one in twists])
    near = np.abs(found.late) <= LATEST_S
    # A constant lateness causes no error, so remove its mean, which would otherwise count in every
    # part.
    late = np.where(near, found.late - found.late[near].mean(), 0.0)
    parts = np.zeros((len(t) - 1, 2))
    parts[:-1] = -late[1:-1, None] * np.diff(speeds[1:], axis=0)
    return parts


class _Gaps:
    """The gaps of a drive, judged by the odometry's own model of unseen motion."""

    def __init__(
        self, t: Floats, twists: list[Twist], rolled: list[Twist], found: Places, whole: bool
    ) -> None:
        self.bridged = np.zeros((len(rolled), 2))
        self.stood = np.zeros((len(rolled), 4))
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
                self.stood[k] = dt * mean.linear, dt * mean.angular, along, yaw
                gaps.interrupt(after)
            elif missing and whole:
                self.unseen += missing * found.period
                self.missing += missing
                self.bridged[k] = _bridged(
                    missing * found.period, moved, before, after, mean, found.period, gaps
                )
                gaps.interrupt(after)
            else:
                gaps.follow(after, found.period)


def _bridged(
    seconds: float, moved: Twist, before: Twist, after: Twist, mean: Twist, period: float,
    gaps: Gaps,
) -> tuple[float, float]:  # fmt: skip
    """Return the variances (m2, rad2) of a gap that odometry filled with a straight line.

    They are the sum of the model's variance for unseen motion and of the square of the deviation
    from the mean of the two speeds.
    """
    along, yaw = gaps.unseen(seconds, before, after)
    off = moved.linear - after.linear * period - mean.linear * seconds
    turned = moved.angular - after.angular * period - mean.angular * seconds
    return along + off * off, yaw + turned * turned
