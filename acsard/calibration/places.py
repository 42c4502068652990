"""Positions of any source as evidence: the path of each block is aligned with the positions.

The residual of a block remains after the wheels' path has been shifted and turned onto the
positions, so no start pose, frame or yaw is needed. Paths are complex numbers x + iy in m.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.evidence import (
    AHEAD,
    ASIDE,
    COUNT,
    LATE,
    LEFT,
    RATE,
    RIGHT,
    TURN,
    Base,
    Evidence,
    huber,
)  # fmt: skip
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import Block, Wheels, cumulative
from acsard.calibration.runs import Complexes, Run

LEAST_POINTS = 5
"""Smallest number of positions in a block, which has three unknowns: shift (two) and rotation."""

FINE_S = 0.02
"""Time step in which the path is summed, s. Finer steps would only make long logs slower."""

JUMP, JUMP_M = 6.0, 0.05
"""Excess of a step over the wheels' motion that counts as a jump.

It is the sum of `JUMP` standard deviations and `JUMP_M` m. The position is an outlier, or the first
one after the source has relocalized.
"""

SLOPE_S = 0.05
"""Half of the interval from which the path's speed is computed, s."""


class Spots(Struct, frozen=True):
    """The positions of a block between two jumps of their source."""

    block: int
    run: int
    t: Floats
    place: Complexes


class Grid(Struct, frozen=True):
    """Wheel angles of a run in sufficiently fine steps."""

    t: Floats
    left: Floats
    """Angle that the left wheels roll in each step, rad."""
    right: Floats
    fast: Floats
    """|right - left| (right - left) in each step, rad2/s."""


class Path(Struct, frozen=True):
    """The path of a run by the wheels at the grid's times, and its derivatives by the parameters.

    Between the times it is linear.
    """

    t: Floats
    place: Complexes
    heading: Floats
    slopes: dict[int, Complexes]
    bends: dict[int, Floats]
    """Derivatives of the heading by each parameter, rad."""

    def at(self, t: Floats, parameters: Floats) -> tuple[Complexes, Complexes]:
        """Return the sensor's place at these times of the positions, and its slopes.

        The slopes have COUNT columns.
        """
        t = t - parameters[LATE]
        slopes = np.zeros((len(t), COUNT), dtype=np.complex128)
        here, ahead = self._sensor(t, parameters)
        lever = 1j * complex(parameters[AHEAD], parameters[ASIDE]) * ahead
        for index, values in self.slopes.items():
            bend = np.interp(t, self.t, self.bends[index])
            slopes[:, index] = np.interp(t, self.t, values) + lever * bend
        slopes[:, AHEAD], slopes[:, ASIDE] = ahead, 1j * ahead
        before, after = (self._sensor(t + s, parameters)[0] for s in (-SLOPE_S, SLOPE_S))
        slopes[:, LATE] = (before - after) / (2 * SLOPE_S)
        return here, slopes

    def _sensor(self, t: Floats, parameters: Floats) -> tuple[Complexes, Complexes]:
        """Return the sensor's place, and the robot's direction as a unit number."""
        ahead = np.exp(1j * np.interp(t, self.t, self.heading))
        lever = complex(parameters[AHEAD], parameters[ASIDE])
        return np.interp(t, self.t, self.place) + lever * ahead, ahead


def spots(driven: Sequence[Run], angles: Sequence[Wheels], parts: Sequence[Block]) -> list[Spots]:
    """Return the positions of each block, split at jumps."""
    edges = [jumps(run, turned) for run, turned in zip(driven, angles, strict=True)]
    found = []
    for number, part in enumerate(parts):
        run = driven[part.run]
        a, b = np.searchsorted(run.place_t, (part.begin, part.end))
        cuts = edges[part.run]
        for piece in np.split(np.arange(a, b), cuts[(cuts > a) & (cuts < b)] - a):
            if len(piece) >= LEAST_POINTS:
                found.append(Spots(number, part.run, run.place_t[piece], run.place[piece]))
    return found


def jumps(run: Run, turned: Wheels) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the indices of positions that do not follow from the one before."""
    steps = np.abs(np.diff(run.place))
    if len(steps) < LEAST_POINTS:
        return np.zeros(0, dtype=np.int64)
    left, right = turned.angles(run.place_t)
    rolled = np.maximum(np.abs(np.diff(left)), np.abs(np.diff(right)))
    moving = rolled > 0.25 * float(np.max(rolled))
    per_rad = float(np.median(steps[moving] / rolled[moving])) if moving.any() else 0.0
    beyond = steps - per_rad * rolled
    usual = 1.4826 * float(np.median(np.abs(beyond - np.median(beyond))))
    return np.flatnonzero(beyond > JUMP * usual + JUMP_M) + 1


def grid(run: Run, turned: Wheels, fine_s: float = FINE_S) -> Grid:
    """Return the steps in which a run's path is summed."""
    usual = float(np.median(np.diff(run.t)))
    every = max(1, int(fine_s / usual))
    kept = np.unique(np.append(np.arange(0, len(run.t), every), len(run.t) - 1))
    t, left, right = run.t[kept], turned.left[kept], turned.right[kept]
    apart, steps = turned.apart((t[1:] + t[:-1]) / 2), np.diff(t)
    return Grid(t, np.diff(left), np.diff(right), np.abs(apart) * apart * steps)


def path(steps: Grid, base: Base, parameters: Floats) -> Path:
    """Return the path from (0, 0, 0) in exact arcs, with the summed slopes of all steps."""
    left, right, turn, rate = parameters[[LEFT, RIGHT, TURN, RATE]]
    gain = base.gain * turn
    mean = gain * (left + right) / 2
    bends = {
        LEFT: -gain * steps.left,
        RIGHT: gain * steps.right,
        TURN: base.gain * (right * steps.right - left * steps.left),
        RATE: -mean * abs(mean) * steps.fast,
    }
    turns = turn * bends[TURN] + rate * bends[RATE]
    rolls = {LEFT: base.radius * steps.left / 2, RIGHT: base.radius * steps.right / 2}
    distance = left * rolls[LEFT] + right * rolls[RIGHT]
    heading, ahead = _directions(turns)
    slopes, swung = {}, {}
    for index, bend in bends.items():
        swung[index] = cumulative(bend)
        middle = swung[index][:-1] + bend / 2
        slopes[index] = _sums(ahead * (rolls.get(index, 0.0) + 1j * distance * middle))
    return Path(steps.t, _sums(ahead * distance), heading, slopes, swung)


def place(steps: Grid, base: Base, parameters: Floats) -> Complexes:
    """Return the place of the robot at the grid's times, without the other fields of a `Path`."""
    left, right = parameters[LEFT] * steps.left, parameters[RIGHT] * steps.right
    _, ahead = _directions(base.gain * parameters[TURN] * (right - left))
    return _sums(ahead * base.radius * (left + right) / 2)


def _directions(turns: Floats) -> tuple[Floats, Complexes]:
    """Return the headings at the step ends, and each step's chord for an arc of length 1."""
    heading = cumulative(turns)
    return heading, np.exp(1j * (heading[:-1] + turns / 2)) * np.sinc(turns / (2 * np.pi))


def _sums(steps: Complexes) -> Complexes:
    return np.concatenate((np.zeros(1, dtype=np.complex128), np.cumsum(steps)))


Paths = Sequence[Path] | Mapping[int, Path]
"""Paths by the number of the run."""


class Laid(Struct, frozen=True):
    """A path aligned with positions: residuals in m, and slopes without shift and rotation."""

    block: int
    residual: Complexes
    slopes: Complexes


def laid(found: Sequence[Spots], paths: Paths, parameters: Floats) -> Iterator[Laid]:
    """Yield the path of each block, aligned with its positions. Outliers count less."""
    for spot in found:
        place, slopes = paths[spot.run].at(spot.t, parameters)
        weight = np.ones(len(place))
        for _ in range(3):
            share = weight / weight.sum()
            seen, gone = spot.place - share @ spot.place, place - share @ place
            match = np.vdot(gone, weight * seen)
            turn = match / abs(match) if match else 1.0
            residual = seen - turn * gone
            weight = huber(residual, 1e-6)
        columns = turn * (slopes - share @ slopes)
        across = 1j * turn * gone
        size = float(np.sum(weight * np.abs(gone) ** 2))
        if size:
            along = np.real(np.conj(across) @ (weight[:, None] * columns)) / size
            columns = columns - across[:, None] * along
        root = np.sqrt(weight)
        yield Laid(spot.block, root * residual, root[:, None] * columns)


def evidence(found: Sequence[Spots], paths: Paths, parameters: Floats, blocks: int) -> Evidence:
    """Return the evidence at these parameters."""
    normal, score = np.zeros((blocks, COUNT, COUNT)), np.zeros((blocks, COUNT))
    squares, counts = np.zeros(blocks), np.zeros(blocks)
    for one in laid(found, paths, parameters):
        conj = np.conj(one.slopes.T)
        normal[one.block] += np.real(conj @ one.slopes)
        score[one.block] += np.real(conj @ one.residual)
        squares[one.block] += float(np.sum(np.abs(one.residual) ** 2))
        counts[one.block] += 2 * len(one.residual) - 3
    return Evidence(normal, score, squares, counts)


def spread(found: Sequence[Spots], paths: Paths, parameters: Floats) -> float:
    """Return the rms distance of positions from the paths aligned with them, m."""
    sums = [(float(np.sum(np.abs(o.residual) ** 2)), len(o.residual))
            for o in laid(found, paths, parameters)]  # fmt: skip
    return float(np.sqrt(sum(s for s, _ in sums) / max(1, sum(n for _, n in sums))))
