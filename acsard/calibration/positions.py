"""Compares the robot's path, computed from the wheels, with measured positions from any source.

The path of each block is first shifted and rotated so that it fits the positions best. So neither
the start pose nor the frame of the positions matters. The fit must start from a track that is
nearly right, which `search` finds. Places are complex numbers x + iy in m.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.fit import PARAMETER_COUNT, RADII, Base, Evidence, Parameter, fit, huber
from acsard.calibration.log_table import Floats
from acsard.calibration.runs import Block, Complexes, Run, cumulative

MIN_POINTS = 5  # positions in a segment

STEP_S = 0.02  # for integrating the path; finer steps add no accuracy

JUMP, JUMP_M = 6.0, 0.05

SPEED_HALF_INTERVAL_S = 0.05  # from which the speed of the position sensor is computed


def extent(places: Complexes) -> float:
    """Return the width plus the height of the bounding box of some places, m."""
    return float(np.ptp(places.real) + np.ptp(places.imag))


class Segment(Struct, frozen=True):
    """Measured positions in one block (a few seconds) of a run, without a jump between them."""

    block: int
    run: int
    t: Floats  # times of the positions, s
    place: Complexes  # positions x + iy, m


class WheelSteps(Struct, frozen=True):
    """The angles by which the wheels rolled in a run, step by step."""

    t: Floats  # times at which the steps begin and end, s: one more than steps
    left: Floats  # angle that the left wheels roll in each step, rad
    right: Floats  # angle that the right wheels roll in each step, rad
    signed_square_integral: Floats  # of |w| w, rad2/s, with w right minus left wheel speed


class WheelPath(Struct, frozen=True):
    """The path of the robot in a run, computed from the wheels, linear between the times `t`."""

    parameters: Floats  # shape (PARAMETER_COUNT,)
    t: Floats  # times of the points of the path, s
    place: Complexes  # place x + iy of the robot at the times `t`, m
    heading: Floats  # heading of the robot at the times `t`, rad
    # With respect to the radii, the inverse track and the track growth.
    derivatives: dict[Parameter, Complexes]  # of `place`
    heading_derivatives: dict[Parameter, Floats]  # of `heading`

    def at(self, t: Floats) -> tuple[Complexes, Complexes]:
        """Return the places of the position sensor at recorded times `t`, and their derivatives.

        The derivatives are with respect to the parameters, shape (times, PARAMETER_COUNT).
        """
        t = t - self.parameters[Parameter.DELAY]
        derivatives = np.zeros((len(t), PARAMETER_COUNT), dtype=np.complex128)
        here, ahead = self._sensor(t)
        lever = 1j * self._mounting * ahead
        for index, values in self.derivatives.items():
            turned = np.interp(t, self.t, self.heading_derivatives[index])
            derivatives[:, index] = np.interp(t, self.t, values) + lever * turned
        derivatives[:, Parameter.SENSOR_X], derivatives[:, Parameter.SENSOR_Y] = ahead, 1j * ahead
        before, after = (
            self._sensor(t + s)[0] for s in (-SPEED_HALF_INTERVAL_S, SPEED_HALF_INTERVAL_S)
        )
        derivatives[:, Parameter.DELAY] = (before - after) / (2 * SPEED_HALF_INTERVAL_S)
        return here, derivatives

    @property
    def _mounting(self) -> complex:
        return complex(self.parameters[Parameter.SENSOR_X], self.parameters[Parameter.SENSOR_Y])

    def _sensor(self, t: Floats) -> tuple[Complexes, Complexes]:
        ahead = np.exp(1j * np.interp(t, self.t, self.heading))
        return np.interp(t, self.t, self.place) + self._mounting * ahead, ahead


def segments(driven: Sequence[Run], parts: Sequence[Block]) -> list[Segment]:
    """Return the measured positions in the blocks `parts`, split at jumps of the positions.

    Segments with fewer than `MIN_POINTS` positions are left out.
    """
    edges = [jumps(run) for run in driven]
    result = []
    for number, part in enumerate(parts):
        run = driven[part.run]
        a, b = np.searchsorted(run.place_t, (part.begin, part.end))
        cuts = edges[part.run]
        for piece in np.split(np.arange(a, b), cuts[(cuts > a) & (cuts < b)] - a):
            if len(piece) >= MIN_POINTS:
                result.append(Segment(number, part.run, run.place_t[piece], run.place[piece]))
    return result


def jumps(run: Run) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the index of the first position after each jump of the positions."""
    steps = np.abs(np.diff(run.place))
    if len(steps) < MIN_POINTS:
        return np.zeros(0, dtype=np.int64)
    left, right = run.angles(run.place_t)
    rolled = np.maximum(np.abs(np.diff(left)), np.abs(np.diff(right)))
    moving = rolled > 0.25 * float(np.max(rolled))
    per_rad = float(np.median(steps[moving] / rolled[moving])) if moving.any() else 0.0
    beyond = steps - per_rad * rolled
    usual = 1.4826 * float(np.median(np.abs(beyond - np.median(beyond))))
    return np.flatnonzero(beyond > JUMP * usual + JUMP_M) + 1


def wheel_steps(run: Run, fine_s: float = STEP_S) -> WheelSteps:
    """Return the angles by which the wheels rolled in steps of `fine_s` s, or longer."""
    usual = float(np.median(np.diff(run.t)))
    every = max(1, int(fine_s / usual))
    indices = np.unique(np.append(np.arange(0, len(run.t), every), len(run.t) - 1))
    t, left, right = run.t[indices], *(angles[indices] for angles in run.rolled)
    apart, steps = run.speed_difference((t[1:] + t[:-1]) / 2), np.diff(t)
    return WheelSteps(t, np.diff(left), np.diff(right), np.abs(apart) * apart * steps)


def path(steps: WheelSteps, base: Base, parameters: Floats) -> WheelPath:
    """Return the path of the robot from the origin with heading 0, in exact arcs."""
    left, right, turn, growth = parameters[: Parameter.DELAY]
    gain = base.radius_per_separation * turn
    mean = gain * (left + right) / 2
    turn_derivatives = {
        Parameter.LEFT: -gain * steps.left,
        Parameter.RIGHT: gain * steps.right,
        Parameter.INVERSE_TRACK: base.radius_per_separation
        * (right * steps.right - left * steps.left),
        Parameter.TRACK_GROWTH: -mean * abs(mean) * steps.signed_square_integral,
    }
    turns = (
        turn * turn_derivatives[Parameter.INVERSE_TRACK]
        + growth * turn_derivatives[Parameter.TRACK_GROWTH]
    )
    rolls = {
        Parameter.LEFT: base.radius * steps.left / 2,
        Parameter.RIGHT: base.radius * steps.right / 2,
    }
    distance = left * rolls[Parameter.LEFT] + right * rolls[Parameter.RIGHT]
    heading, ahead = _directions(turns)
    derivatives, heading_derivatives = {}, {}
    for index, of_step in turn_derivatives.items():
        heading_derivatives[index] = cumulative(of_step)
        middle = heading_derivatives[index][:-1] + of_step / 2
        derivatives[index] = cumulative(ahead * (rolls.get(index, 0.0) + 1j * distance * middle))
    return WheelPath(
        parameters, steps.t, cumulative(ahead * distance), heading, derivatives, heading_derivatives
    )


def place(steps: WheelSteps, base: Base, parameters: Floats) -> Complexes:
    """Return the places (x + iy, m) of `path()`, without its other results, to save time.

    The parameter TRACK_GROWTH must be 0.
    """
    left, right = parameters[Parameter.LEFT] * steps.left, parameters[Parameter.RIGHT] * steps.right
    _, ahead = _directions(
        base.radius_per_separation * parameters[Parameter.INVERSE_TRACK] * (right - left)
    )
    return cumulative(ahead * base.radius * (left + right) / 2)


def _directions(turns: Floats) -> tuple[Floats, Complexes]:
    heading = cumulative(turns)
    return heading, np.exp(1j * (heading[:-1] + turns / 2)) * np.sinc(turns / (2 * np.pi))


Paths = Sequence[WheelPath] | Mapping[int, WheelPath]  # by the index of the run


class Aligned(Struct, frozen=True):
    """The positions of a segment, compared with the path that fits them best."""

    block: int
    # Both times the square root of the position's weight.
    residual: Complexes  # position minus aligned path, m
    derivatives: Complexes  # of the aligned path, shape (positions, PARAMETER_COUNT)


def aligned(segments: Sequence[Segment], paths: Paths) -> Iterator[Aligned]:
    """Yield the positions of each segment, compared with the path that fits them best.

    The path is shifted and rotated. Outliers have smaller weights.
    """
    for segment in segments:
        place, derivatives = paths[segment.run].at(segment.t)
        weight = np.ones(len(place))
        for _ in range(3):
            share = weight / weight.sum()
            centred, centred_path = segment.place - share @ segment.place, place - share @ place
            match = np.vdot(centred_path, weight * centred)
            turn = match / abs(match) if match else 1.0
            residual = centred - turn * centred_path
            weight = huber(residual, 1e-6)
        columns = turn * (derivatives - share @ derivatives)
        across = 1j * turn * centred_path
        size = float(np.sum(weight * np.abs(centred_path) ** 2))
        if size:
            along = np.real(np.conj(across) @ (weight[:, None] * columns)) / size
            columns = columns - across[:, None] * along
        root = np.sqrt(weight)
        yield Aligned(segment.block, root * residual, root[:, None] * columns)


def evidence(segments: Sequence[Segment], paths: Paths, blocks: int) -> Evidence:
    """Return the evidence of the positions, which is their part of the normal equations."""
    normal, score = (
        np.zeros((blocks, PARAMETER_COUNT, PARAMETER_COUNT)),
        np.zeros((blocks, PARAMETER_COUNT)),
    )
    squares, counts = np.zeros(blocks), np.zeros(blocks)
    for part in aligned(segments, paths):
        conj = np.conj(part.derivatives.T)
        normal[part.block] += np.real(conj @ part.derivatives)
        score[part.block] += np.real(conj @ part.residual)
        squares[part.block] += float(np.sum(np.abs(part.residual) ** 2))
        # The alignment uses up three of the numbers: a shift and a rotation.
        counts[part.block] += 2 * len(part.residual) - 3
    return Evidence(normal, score, squares, counts)


def spread(segments: Sequence[Segment], paths: Paths) -> float:
    """Return the RMS distance between the positions and the aligned paths, m."""
    squares, count = 0.0, 0
    for part in aligned(segments, paths):
        squares += float(np.sum(np.abs(part.residual) ** 2))
        count += len(part.residual)
    return float(np.sqrt(squares / max(1, count)))


# Configured / true track; closer together in the usual range.
INVERSE_TRACK_RATIOS = np.unique(
    np.concatenate((np.geomspace(0.03, 10.0, 60), np.geomspace(0.28, 1.4, 40)))
)

DELAYS_S = np.arange(-1.5, 1.55, 0.1)  # delays of the positions that `search` tries

# Segments of the largest extent that try and that refine starting points.
MOST_SEGMENTS, REFINED_SEGMENTS = 60, 20

MAX_POINTS = 80  # of a segment that `search` uses, evenly spaced

# No point is refined whose badness (unexplained variance, more for an unusual robot) is `FAR_WORSE`
# times the best one.
MOST_REFINED, FAR_WORSE = 4, 20.0

# Turn / turn predicted without multipliers. A robot that skids much is at the lower end.
USUAL_TURN_RANGE = 0.31, 1.25

# Usual range of the turn that positions show, divided by the turn that a heading sensor shows.
HEADING_TURN_RANGE = 0.8, 1.25

REVERSAL_PENALTY = 4.0  # of the badness if a side or all turns seem reversed

UNEXPLAINED_OFFSET = 1e-3  # smaller differences are only noise of the positions

MAX_REFINEMENT = 1.3  # of the turn; a larger change is discarded

SEARCH_STEP_S = 0.1  # time step for integrating paths in `search`


class StartingPoint(Struct, frozen=True):
    """Parameters from which a fit to positions can start."""

    parameters: Floats
    unexplained: float  # fraction of the positions' variance


# The search tries tracks from a tenth to thirty times the configured one. It also tries reversed
# turns, and wheels of one side that roll backwards. For each of these trials, the size of the path
# gives the wheel radius.
#
# Positions often determine a turn in place only up to whole turns: the robot faces the same way
# after 90 deg to the left as after 270 deg to the right. If several starting points explain the
# positions about equally well, the search chooses the one that describes the more usual robot.
def search(
    segments: Sequence[Segment], driven: Sequence[Run], base: Base, sides: Floats | None = None
) -> StartingPoint:
    """Return the best parameters from which a fit to the positions can start."""
    subset = _furthest(segments, MOST_SEGMENTS)
    needed = sorted({segment.run for segment in subset})
    steps = {run: wheel_steps(driven[run], SEARCH_STEP_S) for run in needed}
    points: list[StartingPoint] = []
    for left, way in itertools.product((1.0, -1.0), (1.0, -1.0)):
        points += _local_minima(
            [_tried(subset, steps, base, left, way * turn) for turn in INVERSE_TRACK_RATIOS]
        )
    if sides is not None:
        left, way = np.sign(sides[0] * sides[1]), np.sign(sides[1]) * np.abs(sides).mean()
        points.append(_tried(subset, steps, base, float(left), float(way)))

    def badness(point: StartingPoint) -> float:
        return (point.unexplained + UNEXPLAINED_OFFSET) * _penalty(point, sides)

    points.sort(key=badness)
    few, worst = _furthest(subset, REFINED_SEGMENTS), FAR_WORSE * badness(points[0])
    refined = [
        _refined(_timed(point, few, steps, base), few, steps, base)
        for point in points[:MOST_REFINED]
        if badness(point) <= worst
    ]
    return min(refined, key=badness)


def _furthest(segments: Sequence[Segment], most: int) -> list[Segment]:
    reach = [extent(s.place) for s in segments]
    subset = [segments[i] for i in sorted(np.argsort(reach)[::-1][:most])]
    return [
        replace(s, t=s.t[::every], place=s.place[::every])
        for s in subset
        for every in [math.ceil(len(s.t) / MAX_POINTS)]
    ]


def _local_minima(tried: Sequence[StartingPoint]) -> list[StartingPoint]:
    left = [np.inf, *(point.unexplained for point in tried), np.inf]
    return [p for at, p in enumerate(tried) if p.unexplained <= min(left[at], left[at + 2])]


def _penalty(point: StartingPoint, sides: Floats | None) -> float:
    signed = point.parameters[RADII] * point.parameters[Parameter.INVERSE_TRACK]
    turn, (least, most) = float(np.abs(signed).mean()), USUAL_TURN_RANGE
    like = np.ones(2)
    if sides is not None:
        turn, like = turn / max(1e-9, float(np.abs(sides).mean())), np.sign(sides)
        least, most = HEADING_TURN_RANGE
    beyond = max(0.0, np.log(least / turn), np.log(turn / most))
    return (1.0 if np.array_equal(np.sign(signed), like) else REVERSAL_PENALTY) * float(
        1.0 + 2.0 * beyond
    )


def _turn(parameters: Floats) -> float:
    return float(parameters[Parameter.INVERSE_TRACK] * parameters[Parameter.RIGHT])


def _timed(
    point: StartingPoint, subset: Sequence[Segment], steps: dict[int, WheelSteps], base: Base
) -> StartingPoint:
    left, turn = float(np.sign(point.parameters[Parameter.LEFT])), _turn(point.parameters)
    tried = [_tried(subset, steps, base, left, turn, delay_s) for delay_s in DELAYS_S]
    return min([point, *tried], key=lambda point: point.unexplained)


def _tried(
    subset: Sequence[Segment],
    steps: dict[int, WheelSteps],
    base: Base,
    left: float,
    turn: float,
    delay_s: float = 0.0,
) -> StartingPoint:
    parameters = base.start()
    parameters[: Parameter.TRACK_GROWTH] = left, 1.0, turn
    parameters[Parameter.DELAY] = delay_s
    paths = {run: place(of_run, base, parameters) for run, of_run in steps.items()}
    cross = squares = size = 0.0
    for segment in subset:
        along = np.interp(segment.t - delay_s, steps[segment.run].t, paths[segment.run])
        centred, centred_path = segment.place - segment.place.mean(), along - along.mean()
        # Each path is rotated to fit best, but all paths share one scale.
        cross += abs(complex(np.vdot(centred_path, centred)))
        size += float(np.sum(np.abs(centred_path) ** 2))
        squares += float(np.sum(np.abs(centred) ** 2))
    if not size or not squares:
        return StartingPoint(parameters, np.inf)
    scale = cross / size
    parameters[RADII] *= scale
    parameters[Parameter.INVERSE_TRACK] /= scale
    return StartingPoint(parameters, 1.0 - cross**2 / (size * squares))


def _refined(
    point: StartingPoint, few: Sequence[Segment], steps: dict[int, WheelSteps], base: Base
) -> StartingPoint:
    segments = [replace(segment, block=number) for number, segment in enumerate(few)]

    def source(parameters: Floats) -> Evidence:
        return evidence(segments, paths(parameters), len(segments))

    def paths(parameters: Floats) -> dict[int, WheelPath]:
        return {run: path(of_run, base, parameters) for run, of_run in steps.items()}

    def unexplained(parameters: Floats) -> float:
        squares = sum(float(np.sum(np.abs(s.place - s.place.mean()) ** 2)) for s in segments)
        off = spread(segments, paths(parameters))
        return off**2 * sum(len(s.t) for s in segments) / squares if squares else np.inf

    before = StartingPoint(point.parameters, unexplained(point.parameters))
    if not np.isfinite(before.unexplained):
        return point
    parameters = fit([source], point.parameters, places=True).parameters
    moved = _turn(parameters) / _turn(point.parameters)
    if not 1 / MAX_REFINEMENT < moved < MAX_REFINEMENT:
        return before  # the data does not determine the turn there
    after = StartingPoint(parameters, unexplained(parameters))
    return min([before, after], key=lambda point: point.unexplained)
