"""Motion of the wheels in a run: angles over time, rests, and the blocks that the run is cut into.

A block is a few seconds of driving. All estimates are sums over blocks, and the standard deviations
come from the disagreement between blocks. Errors within a block are correlated, since a skid lasts
as long as its turn; errors of different blocks hardly are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Run

GAP_S, GAP_PERIODS = 0.3, 5.0
"""Distance of samples, in s and in usual periods, above both of which there is a gap.

Nothing is known of the motion within a gap.
"""

STILL = 0.02
"""Speed below which a wheel stands, rad/s."""

BLOCKS = 16
SHORTEST_S, LONGEST_S = 4.0, 12.0
"""Target length of blocks, s; `BLOCKS` is the target number."""

SMOOTH_S = 0.3
"""Time over which a turn rate is averaged before it is squared, s.

A coarse encoder otherwise shows 0 or far too much.
"""

LEAST_TURN = 0.2
"""Turn of the faster side, rad, below which a block is not used."""


class Wheels(Struct, frozen=True):
    """Angle of each side in rad at times `t`. Motion within gaps is left out."""

    t: Floats
    left: Floats
    right: Floats
    gaps: Floats
    """Gaps, one row (begin, end) each, in s."""

    def angles(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the angles of left and right at any times."""
        return np.interp(t, self.t, self.left), np.interp(t, self.t, self.right)

    def apart(self, t: Floats) -> Floats:
        """Return the speed of right minus left around these times, rad/s."""
        begin, end = (np.clip(t + s / 2, self.t[0], self.t[-1]) for s in (-SMOOTH_S, SMOOTH_S))
        (left, right), (far_left, far_right) = self.angles(begin), self.angles(end)
        turned = far_right - right - (far_left - left)
        return np.asarray(turned / np.maximum(end - begin, 1e-9))


class Block(Struct, frozen=True):
    """A part of a run, in s."""

    run: int
    begin: float
    end: float


def gaps(t: Floats) -> Floats:
    """Return the gaps between sample times, one row (begin, end) each."""
    steps = np.diff(t)
    if not len(steps):
        return np.zeros((0, 2))
    wide = steps > max(GAP_S, GAP_PERIODS * float(np.median(steps)))
    return np.column_stack((t[:-1][wide], t[1:][wide]))


def inside(begin: Floats, end: Floats, holes: Floats) -> npt.NDArray[np.bool_]:
    """Return a mask of the intervals that touch none of the gaps."""
    after = np.searchsorted(holes[:, 1], begin, side="right")
    before = np.searchsorted(holes[:, 0], end, side="left")
    return np.asarray(after == before)


def wheels(run: Run) -> Wheels:
    """Return the angles of a run, integrated from its speeds by the trapezoidal rule."""
    holes = gaps(run.t)
    steps = np.diff(run.t)
    steps[np.isin(run.t[:-1], holes[:, 0])] = 0.0
    angles = [cumulative((v[1:] + v[:-1]) / 2 * steps) for v in (run.left, run.right)]
    return Wheels(run.t, angles[0], angles[1], holes)


def cumulative(steps: Floats) -> Floats:
    """Return the cumulative sums from 0 on, one element more than `steps` has."""
    return np.concatenate((np.zeros(1), np.cumsum(steps)))


def rests(run: Run, least_s: float, edge_s: float) -> Floats:
    """Return (begin, end) of each time in which all wheels stood.

    A margin of `edge_s` is cut off at both ends, and at least `least_s` must remain.
    """
    moving = (np.abs(run.left) > STILL) | (np.abs(run.right) > STILL)
    changes = np.flatnonzero(np.diff(np.concatenate(([True], moving, [True])).astype(np.int8)))
    spans = [(run.t[a], run.t[b - 1]) for a, b in changes.reshape(-1, 2)]
    found = [(a + edge_s, b - edge_s) for a, b in spans if b - a >= least_s + 2 * edge_s]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def blocks(driven: Sequence[Run], angles: Sequence[Wheels], shortest_s: float) -> list[Block]:
    """Return the blocks of all runs in which the robot moved."""
    moved = sum(_moving_s(run) for run in driven)
    length = float(np.clip(moved / BLOCKS, shortest_s, max(LONGEST_S, shortest_s)))
    found = []
    for number, (run, turned) in enumerate(zip(driven, angles, strict=True)):
        ends = np.concatenate((turned.gaps[:, 0], run.t[-1:]))
        begins = np.concatenate((run.t[:1], turned.gaps[:, 1]))
        for begin, end in zip(begins, ends, strict=True):
            count = max(1, round((end - begin) / length))
            edges = np.linspace(begin, end, count + 1)
            left, right = turned.angles(edges)
            for at in range(count):
                a, b = edges[at], edges[at + 1]
                if b > a and _turned(run, a, b, left[at : at + 2], right[at : at + 2]):
                    found.append(Block(number, float(a), float(b)))
    return found


def _turned(run: Run, begin: float, end: float, left: Floats, right: Floats) -> bool:
    """Return whether the wheels turned enough there; turning back and forth counts as well."""
    if max(abs(left[1] - left[0]), abs(right[1] - right[0])) >= LEAST_TURN:
        return True
    a, b = np.searchsorted(run.t, (begin, end))
    speed = max(float(np.sum(np.abs(v[a:b]))) for v in (run.left, run.right))
    return bool(speed * (end - begin) / max(1, b - a) >= LEAST_TURN)


def _moving_s(run: Run) -> float:
    moving = (np.abs(run.left) > STILL) | (np.abs(run.right) > STILL)
    steps = np.minimum(np.diff(run.t), GAP_S)
    return float(np.sum(steps[moving[1:]]))
