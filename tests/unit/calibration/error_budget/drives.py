"""Random drives, the board's lines in them, and the error of odometry from these lines.

The true path is known. Each function makes lines with one cause of error and sums them in numpy, as
odometry does. This module shares no code with the error budget that it tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.error_budget.measured_errors import Line

Array = npt.NDArray[np.floating[Any]]

GRID, PERIOD = 0.001, 0.01
RADIUS, TRACK = 0.05, 0.30
RIPPLE = 0.03
"""Variation of each side's speed from report to report, rad/s.

Real wheels do not turn more evenly.
"""


class ReportedDrive(Struct, frozen=True):
    """The lines of a drive, and the final position error of odometry that uses these lines."""

    lines: list[Line]
    metres: float
    off: float
    """Error of the final position, m."""


class Drive:
    """Angles of both sides over time, of a drive with turns and stops."""

    def __init__(self, seed: int, seconds: float) -> None:
        self.rng = np.random.default_rng(seed)
        count = int(seconds / GRID)
        linear = _ramped(self.rng, count, -0.6, 1.0, 1.0)
        angular = _ramped(self.rng, count, -1.0, 1.0, 4.0)
        every = int(PERIOD / GRID)
        angles = []
        for way in (-1.0, 1.0):
            speed = (linear + way * angular * TRACK / 2) / RADIUS
            speed += np.repeat(self.rng.normal(0, RIPPLE, count // every + 1), every)[:count]
            angles.append(np.concatenate([[0.0], np.cumsum(speed) * GRID])[::every])
        self.left, self.right = angles
        self.t: Array = np.arange(len(self.left)) * PERIOD

    def report(
        self,
        at: Array,
        left: Array,
        right: Array,
        dt: Array,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> ReportedDrive:
        """Integrate the speeds of the lines as odometry does, and return lines and final error.

        `at` has the timestamps of the lines. `mask` marks the lines that arrive.
        """
        x, y, _ = _path(np.diff(self.left), np.diff(self.right))
        moved = left * dt, right * dt
        ex, ey, eyaw = _path(*moved)
        lines = []
        positions = np.cumsum(moved, axis=1)
        for k in range(len(at)):
            first, other = float(left[k]), float(right[k])
            a, b = float(positions[0, k]), float(positions[1, k])
            lines.append(
                Line(float(at[k]), (other, first, first, other), (b, a, a, b), float(eyaw[k]), 0.0)
            )
        metres = float(np.abs(np.diff(self.left) + np.diff(self.right)).sum()) * RADIUS / 2
        return ReportedDrive(lines, metres, float(np.hypot(x[-1] - ex[-1], y[-1] - ey[-1])))

    def speeds(self) -> tuple[Array, Array]:
        """Return the mean speeds of each period, rad/s."""
        return np.diff(self.left) / PERIOD, np.diff(self.right) / PERIOD


def late(seed: int, seconds: float, how: str) -> ReportedDrive:
    """Return a drive whose timestamps are the times at which the host read the lines.

    `how` says why they are late: an adapter that sends lines in batches, or stalls of the host.
    """
    drive = Drive(seed, seconds)
    left, right = drive.speeds()
    true, rng = drive.t[1:], drive.rng
    if how == "batches":
        at = np.ceil(true / 0.016) * 0.016 + rng.exponential(0.0003, len(true))
    elif how == "stalls":
        at = true.copy()
        for begin in np.arange(1.0, seconds, 3.0) + rng.uniform(
            0, 1.0, len(np.arange(1.0, seconds, 3.0))
        ):
            in_stall = (at >= begin) & (at < begin + 0.08)
            at[in_stall] = begin + 0.08
    else:
        at = true + rng.exponential(0.002, len(true))
    at = np.maximum.accumulate(at)
    return drive.report(at, left, right, np.diff(at, prepend=at[0] - PERIOD))


def rounded(seed: int, seconds: float, counts: int = 0) -> ReportedDrive:
    """Return a drive with speeds rounded to two decimals.

    If `counts` is not 0, the firmware computes each speed from whole counts, `counts` per turn.
    """
    drive = Drive(seed, seconds)
    left, right = drive.speeds()
    if counts:
        step = 2 * np.pi / counts
        phases = drive.rng.uniform(0, step, 2)
        left, right = (
            np.diff(np.floor((angle + phase) / step)) * step / PERIOD
            for angle, phase in zip((drive.left, drive.right), phases, strict=True)
        )
    left, right = np.round(left, 2), np.round(right, 2)
    return drive.report(drive.t[1:], left, right, np.full(len(left), PERIOD))


def lost(
    seed: int, seconds: float, share: float, longest: int, stands: bool = False
) -> ReportedDrive:
    """Return a drive that loses about this share of its lines, up to `longest` in a row.

    The next line's speed is used for all of the missing time. With `stands`, a gap of more than 0.1
    s adds no motion.
    """
    drive = Drive(seed, seconds)
    left, right = drive.speeds()
    mask = np.ones(len(left), dtype=bool)
    for begin in drive.rng.integers(10, len(left) - 60, int(share * len(left) / longest * 2)):
        mask[begin : begin + int(drive.rng.integers(1, longest + 1))] = False
    at = drive.t[1:][mask]
    dt = np.diff(at, prepend=at[0] - PERIOD)
    if stands:
        dt[dt > 0.1] = 0.0
    return drive.report(at, left[mask], right[mask], dt)


def _path(left: Array, right: Array) -> tuple[Array, Array, Array]:
    turn = (right - left) * RADIUS / TRACK
    yaw = np.cumsum(turn)
    half = turn / 2
    chord = (left + right) * RADIUS / 2 * np.sinc(half / np.pi)
    heading = yaw - half
    return np.cumsum(chord * np.cos(heading)), np.cumsum(chord * np.sin(heading)), yaw


def _ramped(rng: np.random.Generator, count: int, lowest: float, most: float, rate: float) -> Array:
    """Return a speed that changes at `rate` towards random targets.

    A sixth of the targets are zero.
    """
    targets: list[float] = []
    while len(targets) < count:
        target = 0.0 if rng.random() < 1 / 6 else float(rng.uniform(lowest, most))
        targets += [target] * int(rng.uniform(0.8, 4.0) / GRID)
    speeds, speed = np.empty(count), 0.0
    for i, target in enumerate(targets[:count]):
        speed += min(max(target - speed, -rate * GRID), rate * GRID)
        speeds[i] = speed
    return speeds
