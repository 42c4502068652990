"""Angles of the wheels over time, the rests of a run, and the blocks that a run is cut into.

A block is a few seconds of driving. Every estimate of the calibration is a sum over blocks, and the
standard deviations come from the differences between blocks. The errors within a block are
correlated, because a wheel skids throughout a turn. The errors of different blocks are nearly
independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Run

GAP_S, GAP_PERIODS = 0.3, 5.0
"""Interval between two samples above which there is a gap: in s, and in usual periods.

A gap exceeds both. The motion within a gap is unknown.
"""

STILL = 0.02
"""Speed below which a wheel stands, rad/s."""

BLOCKS = 16
"""Number of blocks that a log should have. Their length is limited by `LONGEST_S`."""

LONGEST_S = 12.0
"""Longest block, s, unless the caller asks for longer ones."""

SMOOTH_S = 0.3
"""Time over which a wheel speed is averaged before it is squared, s.

Without it, the speeds of a coarse encoder would be 0 in some samples and far too large in others.
"""

LEAST_TURN = 0.2
"""Angle of the faster side's wheels, rad, below which a block is not used."""


class WheelAngles(Struct, frozen=True):
    """The angles that the left and the right wheels of a run have rolled. Gaps add nothing."""

    t: Floats
    """Times of the samples, s."""
    left: Floats
    """Angle of the left wheels at these times, rad."""
    right: Floats
    gaps: Floats
    """Gaps, one row (begin, end) each, in s."""

    def angles(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the angles of the left and the right wheels at these times, rad."""
        return np.interp(t, self.t, self.left), np.interp(t, self.t, self.right)

    def speed_difference(self, t: Floats) -> Floats:
        """Return the speed of the right wheels minus that of the left at these times, rad/s.

        It is an average over `SMOOTH_S`.
        """
        begin, end = (np.clip(t + s / 2, self.t[0], self.t[-1]) for s in (-SMOOTH_S, SMOOTH_S))
        (left, right), (far_left, far_right) = self.angles(begin), self.angles(end)
        turned = far_right - right - (far_left - left)
        return np.asarray(turned / np.maximum(end - begin, 1e-9))


class Block(Struct, frozen=True):
    """A part of a run."""

    run: int
    """Number of the run."""
    begin: float
    """Time in s, like `end`."""
    end: float


def gaps(t: Floats) -> Floats:
    """Return the gaps between sample times, one row (begin, end) each."""
    steps = np.diff(t)
    if not len(steps):
        return np.zeros((0, 2))
    wide = steps > max(GAP_S, GAP_PERIODS * float(np.median(steps)))
    return np.column_stack((t[:-1][wide], t[1:][wide]))


def inside(begin: Floats, end: Floats, holes: Floats) -> npt.NDArray[np.bool_]:
    """Return a mask of the intervals from `begin` to `end` that touch none of the gaps `holes`."""
    after = np.searchsorted(holes[:, 1], begin, side="right")
    before = np.searchsorted(holes[:, 0], end, side="left")
    return np.asarray(after == before)


def angles_of(run: Run) -> WheelAngles:
    """Return the wheel angles of a run, integrated from its speeds by the trapezoidal rule."""
    holes = gaps(run.t)
    steps = np.diff(run.t)
    steps[np.isin(run.t[:-1], holes[:, 0])] = 0.0
    angles = [cumulative((v[1:] + v[:-1]) / 2 * steps) for v in (run.left, run.right)]
    return WheelAngles(run.t, angles[0], angles[1], holes)


def cumulative(steps: Floats) -> Floats:
    """Return 0 and the cumulative sums of `steps`: one element more than `steps` has."""
    return np.concatenate((np.zeros(1), np.cumsum(steps)))


def rests(run: Run, least_s: float, edge_s: float) -> Floats:
    """Return the rests of a run, one row (begin, end) each, in s. All wheels stand in a rest.

    A margin of `edge_s` is cut off at both ends. Rests of which less than `least_s` remains are
    left out.
    """
    moving = (np.abs(run.left) > STILL) | (np.abs(run.right) > STILL)
    changes = np.flatnonzero(np.diff(np.concatenate(([True], moving, [True])).astype(np.int8)))
    spans = [(run.t[a], run.t[b - 1]) for a, b in changes.reshape(-1, 2)]
    found = [(a + edge_s, b - edge_s) for a, b in spans if b - a >= least_s + 2 * edge_s]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def blocks(driven: Sequence[Run], angles: Sequence[WheelAngles], shortest_s: float) -> list[Block]:
    """Return the blocks of all runs, without those in which the robot hardly moved.

    A block is `shortest_s` long, or longer if the log would otherwise have over `BLOCKS` blocks.
    """
    moved = sum(_moving_s(run) for run in driven)
    length = float(np.clip(moved / BLOCKS, shortest_s, max(LONGEST_S, shortest_s)))
    found = []
    for number, (run, wheels) in enumerate(zip(driven, angles, strict=True)):
        ends = np.concatenate((wheels.gaps[:, 0], run.t[-1:]))
        begins = np.concatenate((run.t[:1], wheels.gaps[:, 1]))
        for begin, end in zip(begins, ends, strict=True):
            count = max(1, round((end - begin) / length))
            edges = np.linspace(begin, end, count + 1)
            left, right = wheels.angles(edges)
            for at in range(count):
                a, b = edges[at], edges[at + 1]
                if b > a and _turned(run, a, b, left[at : at + 2], right[at : at + 2]):
                    found.append(Block(number, float(a), float(b)))
    return found


def _turned(run: Run, begin: float, end: float, left: Floats, right: Floats) -> bool:
    """Return whether the wheels turned enough from `begin` to `end`, back and forth included.

    `left` and `right` are the angles at both times.
    """
    if max(abs(left[1] - left[0]), abs(right[1] - right[0])) >= LEAST_TURN:
        return True
    a, b = np.searchsorted(run.t, (begin, end))
    speed = max(float(np.sum(np.abs(v[a:b]))) for v in (run.left, run.right))
    return bool(speed * (end - begin) / max(1, b - a) >= LEAST_TURN)


def _moving_s(run: Run) -> float:
    moving = (np.abs(run.left) > STILL) | (np.abs(run.right) > STILL)
    steps = np.minimum(np.diff(run.t), GAP_S)
    return float(np.sum(steps[moving[1:]]))
