"""A stretch of driving as the bus tells it: what the error budget is made of."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.drive.gap_variance import Gaps
from acsard.drive.kinematics import Kinematics
from acsard.drive.uncertainty import GYRO_SCALE
from acsard.error_budget.line_times import Places, places
from acsard.values import Twist, WheelSpeeds

Floats = npt.NDArray[np.float64]

BLOCK_S = 0.5
"""Errors of time hang together for as long: the longest stall of a host is 0.3 s."""

LEAST_LINES, ALIKE = 20, 0.99
"""Lines on the way that tell what a gyro's noise costs; and the cosine from which on turning and
the time that passes are one and the same."""

LATEST_S = 0.1
"""A line that is later tells when it was read; its way is looked at as a gap's."""

Wheels = tuple[float, float, float, float]


class Line(Struct, frozen=True):
    """A feedback line and what odometry made of it."""

    at: float
    """Its stamp, s."""
    speeds: Wheels
    """rad/s"""
    positions: Wheels
    """rad that the wheels have turned by then."""
    yaw: float
    """rad"""
    yaw_variance: float
    """rad2"""


class Stood(Struct, frozen=True):
    """The pose stood while the robot went on by about so much: m, rad, and how well that is known,
    m2 and rad2."""

    distance: float = 0.0
    turn: float = 0.0
    along: float = 0.0
    yaw: float = 0.0


class Motion(Struct, frozen=True):
    """Of each line but the first: what the robot did since the one before, and what of it erred."""

    seconds: float
    """Of all."""
    period: float
    distance: Floats
    """m, signed."""
    turn: Floats
    """rad"""
    yaw_variance: Floats | None
    """rad2 that odometry itself added with time, None where that cannot be told."""
    late: Floats
    """m and rad that each line's time changed: columns of two."""
    lateness: float
    """s rms, of the lines' stamps."""
    bridged: Floats
    """m2 and rad2 of lines that are missing, where the pose went on without them."""
    stood: dict[int, Stood]
    """By the line at the end of each gap in which it did not."""
    missing: int
    unseen: float
    """s of all gaps."""


def motion(lines: list[Line], sent: Floats, kinematics: Kinematics, whole: bool) -> Motion:
    """`sent` is when lines left for the microcontroller, s. `whole` says that every line the daemon
    got is here: else one that is missing here is none that it missed. Needs 3 lines.
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
    late[[k for k in seen.stood if k < len(late)]] = 0.0
    return Motion(
        float(t[-1] - t[0]), found.period, np.array([one.linear for one in rolled]),
        np.array(turns), growth, late, float(np.sqrt(np.mean(found.late**2))), seen.bridged,
        seen.stood, seen.missing, seen.unseen,
    )  # fmt: skip


def _noise(t: Floats, speeds: Floats, turns: Floats, variances: Floats) -> Floats | None:
    """rad2 by which the heading's variance grows in each line with time alone, while wheels turn.

    What a gyro's scale errs by is squared with all that was turned since the pose was set, so that
    each line adds 2 S2 A dA more, of A before it: found by least squares with it, and left out.
    None where turns and time cannot be told apart.
    """
    # Of a pose that was set anew the variance falls.
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
    """The sum of speed x error of dt, in parts: minus the lateness x the change of speed."""
    speeds = np.array([(one.linear, one.angular) for one in twists])
    near = np.abs(found.late) <= LATEST_S
    # Being late by the same amount changes nothing: what is left of it would count in every part.
    late = np.where(near, found.late - found.late[near].mean(), 0.0)
    parts = np.zeros((len(t) - 1, 2))
    parts[:-1] = -late[1:-1, None] * np.diff(speeds[1:], axis=0)
    return parts


class _Gaps:
    """What was missed, by the odometry's own model of what a robot does unseen."""

    def __init__(
        self, t: Floats, twists: list[Twist], rolled: list[Twist], found: Places, whole: bool
    ) -> None:
        self.bridged = np.zeros((len(rolled), 2))
        self.stood: dict[int, Stood] = {}
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
                self.stood[k] = Stood(dt * mean.linear, dt * mean.angular, along, yaw)
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
    """m2 and rad2: what may have been in between, and what another line across it than the straight
    one is off."""
    along, yaw = gaps.unseen(seconds, before, after)
    off = moved.linear - after.linear * period - mean.linear * seconds
    turned = moved.angular - after.angular * period - mean.angular * seconds
    return along + off * off, yaw + turned * turned
