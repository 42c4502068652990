"""Fits the geometry of a robot to its runs: one Gauss-Newton with one prior.

The parameters are the logarithms of the factors of the configured radii and track, and what the
sensors need beside them. There are no case distinctions: what a log does not show stays as
configured, with the standard deviation of its prior. Each run is left out in turn (long ones are
cut). The errors on the runs that were left out decide whether the new values are better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct, field

from acsard.calibration.comparison import (
    MIN_ROLL,
    STEP_S,
    Match,
    gyro_bias,
    matched,
    sensors,
    weights,
)
from acsard.calibration.geometry import LEFT, RIGHT, TRACK, Base
from acsard.calibration.log import LogError, Run
from acsard.calibration.series import TINY, Complexes, Floats, Mask
from acsard.core.config.settings import Config

BIAS, SCALE, GYRO_DELAY, POSE_DELAY, AHEAD, ASIDE = range(TRACK + 1, TRACK + 7)
GEOMETRY = slice(LEFT, TRACK + 1)
SHARES = np.array([[-0.5, -0.5, 1.0], [-1.0, 1.0, 0.0], [0.5, 0.5, 0.0]])  # of Fit.shares

# Standard deviations before a log is known: tyres and load change the radii by 2 %, and skidding
# may double the track. With the scale of a bad gyro, a track would rather stay as configured.
RADIUS_STD, TRACK_STD, DELAY_STD_S, LEVER_STD_M = 0.02, 1.0, 0.3, 0.2
GYRO_STD = 0.004
SIZE_STD = 0.05  # of both radii alike, if positions show them
HEADING_STEP_S = 3.0  # between two headings, for the report: an error is below half a turn
GRID_S = 0.02  # of the wheels' path
HOLE_S, HOLE_PERIODS = 0.3, 8.0  # a hole in the samples of a gyro is longer than both

FINEST = 1e-4  # rad or m, of any sensor
STEPS, CONVERGED = 15, 0.002  # deviations of the prior
STEP = 1e-7  # the same, of a derivative: at larger ones, medians and weights bend
PIECES = 12  # at least
# A drive by positions alone that is fitted whole. With 12 pieces of 55 s, its path has 2.6 times
# the least error (mean of 6 robots). Longer ones with turns on the spot are worse as a whole.
WHOLE_S = 60.0
MIN_RUNS = 3  # of which each is left out whole, and not a part of it, for the deviations
FARTHEST = 3.0  # deviations of the prior, by which a piece that is left out moves a parameter
# Halves of a log contradict each other if they differ by more than both: those of sound ones
# differ by 1.7 deviations, or by 0.061.
HALVES_DEVIATIONS, HALVES_DIFFERENCE = 3.0, 0.08
MIN_HALVED_PIECES, MAX_HALVES_DIFFERENCE = 8, 0.6

BETTER_DEVIATIONS = 2.0  # by which the new values must be better, or else by half
# ... or the values this far from the configured ones, by sensors: a person misreads a tape. Sound
# robots: 5.9 and less; wrong by 1 %: 9 and more.
FAR_DEVIATIONS = 8.0
CAP = 10.0  # robust standard deviations: a residual of a run that was left out counts as at most
AGREES = 2.0  # deviations of a reading by tape
OTHER_TRACK, SHOWN = 0.4, 1.1  # a log that shows its track fits others worse, by this factor
WORSE = 0.02  # by which the error of one sensor may grow, as a fraction

SENSORS = "gyro", "positions", "headings", "tape"


class Piece:
    """A run, or a part of one, prepared for many evaluations of its residuals."""

    def __init__(self, run: Run, base: Base, sensors: Sequence[str] = SENSORS) -> None:
        self.run, self.base = run, base
        step = max(1, round(GRID_S / float(np.median(np.diff(run.t)))))
        picked = np.append(np.arange(0, len(run.t) - 1, step), len(run.t) - 1)
        self.t, self.left, self.right = run.t[picked], run.left[picked], run.right[picked]
        edges = np.linspace(self.t[0], self.t[-1], max(1, round(run.seconds / STEP_S)) + 1)
        self.begin, self.end = edges[:-1], edges[1:]
        self.rolls = [np.diff(np.interp(edges, run.t, side)) for side in (run.left, run.right)]
        self.rolling = np.abs(self.rolls[0]) + np.abs(self.rolls[1]) > MIN_ROLL
        steps = np.diff(run.gyro_t)
        self.gyro = len(steps) > 1 and "gyro" in sensors
        if self.gyro:
            wide = steps > max(HOLE_S, HOLE_PERIODS * float(np.median(steps)))
            self.hole_begins = np.append(run.gyro_t[:-1][wide], run.gyro_t[-1])
            self.hole_ends = np.append(run.gyro_t[0], run.gyro_t[1:][wide])

    def residuals(self, p: Floats) -> dict[str, Floats]:
        """Return the residuals of each sensor: rad of a gyro or heading, m, or deviations."""
        run, made = self.run, dict[str, Floats]()
        if self.gyro:
            begin, end = self.begin + p[GYRO_DELAY], self.end + p[GYRO_DELAY]
            ends, begins = (np.interp(at, run.gyro_t, run.turned) for at in (end, begin))
            whole = self.rolling & (
                np.searchsorted(self.hole_ends, begin, side="right")
                == np.searchsorted(self.hole_begins, end) + 1
            )
            turned = (ends - begins - p[BIAS] * (end - begin)) * math.exp(p[SCALE])
            made["gyro"] = np.where(whole, turned - self.base.motion(p, *self.rolls)[1], np.nan)
        if not (len(run.place_t) or len(run.yaw_t) or run.tape):
            return made
        place, heading = self.base.path(p, self.left, self.right)
        if len(run.yaw_t):
            at = run.yaw_t - p[POSE_DELAY]
            off = run.yaw - np.interp(at, self.t, heading)
            off = np.angle(np.exp(1j * (off - np.angle(np.exp(1j * off).sum()))))
            made["headings"] = self._inside(at, centered(off))
        if len(run.place_t) > 2:
            at = run.place_t - p[POSE_DELAY]
            model = np.interp(at, self.t, place.real) + 1j * np.interp(at, self.t, place.imag)
            lever = (p[AHEAD] + 1j * p[ASIDE]) * np.exp(1j * np.interp(at, self.t, heading))
            off = aligned(run.place, model + lever).off
            made["positions"] = self._inside(
                np.concatenate((at, at)), np.concatenate((off.real, off.imag))
            )
        if run.tape:
            seen = {"distance": abs(place[-1]), "turn": heading[-1]}
            made["tape"] = np.array([(r.value - seen[r.quantity]) / r.std for r in run.tape])
        return made

    def _inside(self, at: Floats, values: Floats) -> Floats:
        return np.where((at >= self.t[0]) & (at <= self.t[-1]), values, np.nan)


def centered(values: Floats) -> Floats:
    """Return values without their robust mean, which is smooth where a median jumps."""
    off = values
    for _ in range(3):
        weight = weights(off, float(np.median(np.abs(off))))
        off = values - weight @ values / weight.sum()
    return off


def deviations(covariance: Floats) -> Floats:
    """Return the relative deviations of track / mean radius, right / left radius, and radius."""
    return np.asarray(np.sqrt(np.einsum("ri,ij,rj->r", SHARES, covariance, SHARES)))


class Alignment(Struct, frozen=True):
    turn: complex  # from the model to what was seen, of size 1
    weight: Floats  # of each point
    off: Complexes  # what remains of the points, in the axes of the model


def aligned(seen: Complexes, model: Complexes) -> Alignment:
    """Turn and move `model` onto `seen`.

    Three rounds of weights keep single wrong positions from turning the rest.
    """
    weight = np.ones(len(seen))
    for _ in range(3):
        share = weight / weight.sum()
        a, b = seen - share @ seen, model - share @ model
        turn = complex(np.vdot(b, weight * a))
        turn = turn / abs(turn) if turn else 1.0 + 0j
        off = a * turn.conjugate() - b
        size = np.abs(off)
        middle = np.partition(size, len(size) // 2)[len(size) // 2]  # np.median is slow
        weight = weights(size, float(middle))
    return Alignment(turn, weight, off)


class Problem:
    """The pieces of a log, the prior, and the robust size of each sensor's residuals."""

    def __init__(self, pieces: Sequence[Piece], bias: float, stds: Floats) -> None:
        self.pieces, self.stds = pieces, stds
        self.mean = np.zeros(len(stds))
        self.mean[BIAS] = bias
        self.sensors = [s for s in SENSORS if any(s in p.residuals(self.mean) for p in pieces)]
        free = [LEFT, RIGHT, TRACK]
        free += [BIAS, SCALE, GYRO_DELAY] if "gyro" in self.sensors else []
        free += [POSE_DELAY] if {"positions", "headings"} & set(self.sensors) else []
        free += [AHEAD, ASIDE] if "positions" in self.sensors else []
        self.free = np.array(free)
        # The precision of the prior, in its deviations. Positions show the size of both wheels.
        size = (SIZE_STD / RADIUS_STD) ** 2 if "positions" in self.sensors else 0.0
        self.prior = np.eye(len(free))
        self.prior[:TRACK, :TRACK] -= size / (1 + 2 * size)

    def sizes(self, p: Floats) -> dict[str, float]:
        """Return the robust standard deviation of each sensor's residuals."""
        found = [piece.residuals(p) for piece in self.pieces]
        sizes = {s: _robust([r[s] for r in found if s in r]) for s in self.sensors}
        return sizes | {"tape": 1.0}  # readings are few, and come with their deviations

    def normal(self, p: Floats) -> tuple[Floats, Floats, Floats, dict[str, float]]:
        """Return normal matrix, curvature and score of each piece, and the size of each sensor.

        Their units are deviations of the prior. The normal matrices lead to the minimum. Only
        residuals that are no outliers bend it, and the deviations follow from its curvature. Each
        sensor is weighted by the scatter of its pieces' scores, so residuals that repeat each
        other count once.
        """
        sizes, count = self.sizes(p), len(self.free)
        normal = np.zeros((len(self.pieces), len(self.sensors), count, count))
        curvature, score = np.zeros(normal.shape), np.zeros(normal.shape[:-1])
        squares = np.zeros((len(self.sensors), 2))
        for n, piece in enumerate(self.pieces):
            center = piece.residuals(p)
            moved = []
            for index in self.free:
                q, step = p.copy(), STEP * self.stds[index]
                q[index] += step
                moved.append(piece.residuals(q))
            for k, sensor in enumerate(self.sensors):
                if sensor not in center:
                    continue
                e = center[sensor]
                jacobian = np.array([(m[sensor] - e) / STEP for m in moved])
                sound = np.isfinite(e) & np.isfinite(jacobian).all(axis=0)
                e, jacobian = e[sound], jacobian[:, sound]
                weight = weights(e, sizes[sensor])
                # The threads of a matrix product cost more than they save here.
                normal[n, k] = np.einsum("in,jn->ij", jacobian * weight, jacobian)
                curvature[n, k] = np.einsum("in,jn->ij", jacobian * (weight == 1.0), jacobian)
                score[n, k] = -np.einsum("in,n->i", jacobian * weight, e)
                squares[k] += (weight * e * e).sum(), len(e)
        for k, sensor in enumerate(self.sensors):
            inner = np.linalg.pinv(normal[:, k].sum(axis=0), rcond=TINY, hermitian=True)
            apart = score[:, k] - score[:, k].mean(axis=0)
            rank = max(1, int(np.linalg.matrix_rank(inner, hermitian=True)))
            scatter = float(np.einsum("bi,ij,bj->", apart, inner, apart)) / rank
            variance = max(scatter, squares[k, 0] / max(1.0, squares[k, 1]), FINEST**2)
            if sensor == "tape":
                variance = 1.0
            for each in (normal, curvature, score):
                each[:, k] /= variance
        return normal.sum(axis=1), curvature.sum(axis=1), score.sum(axis=1), sizes

    def solve(self, start: Floats, *, fixed: bool = False) -> Solution:
        """Return the best parameters, or what each piece adds to those of the start."""
        p, prior = start.copy(), self.prior
        scale = self.stds[self.free]
        for _ in range(STEPS):
            normal, curvature, score, sizes = self.normal(p)
            if fixed:
                break
            off = (p - self.mean)[self.free] / scale
            step = np.linalg.solve(normal.sum(axis=0) + prior, score.sum(axis=0) - prior @ off)
            step *= min(
                1.0, 0.3 / max(TINY, float(np.abs(step[: TRACK + 1] * scale[: TRACK + 1]).max()))
            )
            p[self.free] += step * scale
            if float(np.abs(step).max()) < CONVERGED:
                break
        found = Solution(p, sizes, self.free, scale, prior, curvature, score)
        found.left_out = np.array([found.without(n) for n in np.eye(len(self.pieces), dtype=bool)])
        found.covariance, found.halves = self._covariance(found)
        return found

    def _covariance(self, found: Solution) -> tuple[Floats, float]:
        # Returns it, and by how much the halves of the log contradict each other. It is the sum of
        # two, each of which misses what the other one sees: the jackknife misses what a single
        # piece shows, and the inverse information that a robot skids for a whole piece. The prior
        # is in the second one.
        scale = np.diag(found.scale)
        # A reading by tape has its deviation, and may be the only one of its kind. Parts of one run
        # share what it errs by, so runs are left out whole, if there are some.
        names = [piece.run.name if not piece.run.tape else "" for piece in self.pieces]
        if len(set(names) - {""}) < MIN_RUNS:
            names = [name and str(n) for n, name in enumerate(names)]
        groups = [np.array(names) == name for name in sorted(set(names) - {""})]
        left_out = np.array([found.without(group)[self.free] for group in groups])
        apart, n = left_out - left_out.sum(axis=0) / max(1, len(groups)), max(1, len(groups))
        jackknife = apart.T @ apart * (n - 1) / n
        made = (jackknife + scale @ np.linalg.inv(found.whole) @ scale)[GEOMETRY, GEOMETRY]
        halves = 0.0
        # Two robots, loads or floors in one log are no scatter of one, so they widen it as a whole.
        ends = np.cumsum([piece.run.seconds for piece in self.pieces])
        if "tape" not in self.sensors and len(ends) >= MIN_HALVED_PIECES:
            first = ends <= ends[-1] / 2
            moved = (found.without(first) - found.without(~first))[GEOMETRY]
            off = np.abs(SHARES @ moved)
            if np.any(off > np.maximum(HALVES_DIFFERENCE, HALVES_DEVIATIONS * deviations(made))):
                halves = min(float(off.max()), MAX_HALVES_DIFFERENCE)
                made += np.outer(moved, moved) * (halves / off.max() / 2) ** 2
        return np.asarray(made), halves


class Solution(Struct):
    """The parameters that fit best, and what each piece adds to them."""

    p: Floats
    sizes: dict[str, float]
    free: npt.NDArray[np.int64]
    scale: Floats  # of the free parameters
    prior: Floats  # its precision
    curvature: Floats  # of each piece
    score: Floats
    left_out: Floats = field(default_factory=lambda: np.zeros(0))  # without each piece
    covariance: Floats = field(default_factory=lambda: np.zeros(0))  # of GEOMETRY
    halves: float = 0.0  # by which the halves of the log contradict each other, as a fraction

    @property
    def whole(self) -> Floats:
        return np.asarray(self.curvature.sum(axis=0) + self.prior)

    def without(self, pieces: Mask) -> Floats:
        """Return about the parameters that fit the other pieces best."""
        p = self.p.copy()
        rest = self.whole - self.curvature[pieces].sum(axis=0)
        step = np.linalg.solve(rest, self.score[pieces].sum(axis=0))
        p[self.free] -= np.clip(step, -FARTHEST, FARTHEST) * self.scale
        return p


def _robust(residuals: Sequence[Floats]) -> float:
    joined = np.concatenate(residuals)
    joined = joined[np.isfinite(joined)]
    return 1.4826 * float(np.median(np.abs(joined))) + TINY if len(joined) else 1.0


def cut(runs: Sequence[Run], least: int = PIECES) -> list[Run]:
    """Return the runs, the longest of them cut so that there are at least `least` of them."""
    shortest = max(3.0, sum(run.seconds for run in runs) / least)
    made = []
    for run in runs:
        count = max(1, round(run.seconds / shortest)) if len(runs) < least and not run.tape else 1
        edges = np.linspace(run.t[0], run.t[-1], count + 1)
        made += [run.part(a, b) for a, b in pairwise(edges)]
    return [run for run in made if len(run.t) > 3 and moves(run)]


def moves(run: Run) -> bool:
    return max(float(np.ptp(run.left)), float(np.ptp(run.right))) > 0.2


class Errors(Struct, frozen=True):
    """Errors on runs that the fit did not use: as configured, and with the new values."""

    now: float
    new: float


class Fit(Struct, frozen=True):
    """The geometry that fits a log, and what it is worth on runs that were left out."""

    base: Base
    p: Floats
    covariance: Floats  # of the logarithms of left radius, right radius and track
    sensors: tuple[str, ...]
    pieces: tuple[Piece, ...]
    without: Callable[[Mask], Floats]  # parameters that fit the other pieces
    gain: float  # logarithm of the ratio of the errors, now to new, of all sensors
    gain_std: float
    worst: float  # the same of the sensor that gains least
    turn: Errors | None  # heading after a turn of 360 deg, rad
    place: Errors | None  # rms of the positions, m
    readings: Errors | None  # rms of a person's readings, in their deviations
    sized: bool  # the log shows the size of the wheels, not only their ratio
    tracked: bool  # the log shows the track: another one fits it worse
    gyro_std: float  # share by which the track errs because no other sensor shows the gyro's scale
    halves: float  # by which the halves of the log contradict each other, as a fraction

    @property
    def better(self) -> bool:
        moved = self.p[GEOMETRY]
        far = float(moved @ np.linalg.solve(self.covariance, moved)) > FAR_DEVIATIONS**2
        surely = self.gain > min(BETTER_DEVIATIONS * self.gain_std, math.log(2.0))
        sure = surely or (far and self.readings is None)
        return sure and self.gain > 0.0 and self.worst > -WORSE

    @property
    def shares(self) -> Floats:
        """Relative deviations of track / mean radius, right / left radius, and mean radius."""
        return np.hypot(deviations(self.covariance), [self.gyro_std, 0.0, 0.0])


def fit(runs: Sequence[Run], config: Config, matches: dict[str, Match] | None = None) -> Fit:
    """Fit the geometry. Raises `LogError` if the wheels never move beside a sensor."""
    base, (bias, bias_std) = Base.of(config.drive), gyro_bias(runs)
    if matches is None:
        matches = {sensor: matched(sensor, runs, base) for sensor in sensors(runs)}
    pieces = [Piece(run, base) for run in cut(runs)]
    stds = np.array([
        RADIUS_STD, RADIUS_STD, TRACK_STD, bias_std, GYRO_STD,
        DELAY_STD_S, DELAY_STD_S, LEVER_STD_M, LEVER_STD_M,
    ])  # fmt: skip
    problem = Problem(pieces, bias, stds)
    if not problem.sensors:
        raise LogError(
            "no gyro and no positions while the wheels turn: record one of them at the same time "
            "as the wheels, with times from the same clock"
        )
    start = _start(problem, matches)
    seconds = sum(run.seconds for run in runs)
    if problem.sensors == ["positions"] and seconds < WHOLE_S:
        # Each piece has a free heading, which short drives cannot afford: they are fitted whole.
        whole = Problem([Piece(run, base) for run in cut(runs, 1)], bias, stds)
        solution = problem.solve(whole.solve(start).p, fixed=True)
    else:
        solution = problem.solve(start)
    return _judged(problem, solution, base, config.odometry.gyro_scale_std)


def _start(problem: Problem, matches: dict[str, Match]) -> Floats:
    p = problem.mean.copy()
    # Turns show the track, if there are any, and positions the size.
    for sensor, match in reversed(matches.items()):
        delay = GYRO_DELAY if sensor == "gyro" else POSE_DELAY
        p[delay] = problem.mean[delay] = match.delay
        p[AHEAD : ASIDE + 1] += match.lever
        p[LEFT:TRACK] += math.log(abs(match.size) + TINY)
        p[TRACK] = math.log(abs(match.track) + TINY) + p[LEFT]
    turns = [
        (piece.base.motion(p, *piece.rolls)[1].sum() / reading.value)
        for piece in problem.pieces for reading in piece.run.tape
        if reading.quantity == "turn" and abs(reading.value) > 1.0
    ]  # fmt: skip
    if turns and not matches:
        p[TRACK] = math.log(max(0.1, float(np.median(turns))))
    return p


def _judged(problem: Problem, solution: Solution, base: Base, gyro_std: float) -> Fit:
    squares = np.zeros((2, len(problem.pieces), len(problem.sensors)))
    counts = np.zeros((len(problem.pieces), len(problem.sensors)))
    for n, piece in enumerate(problem.pieces):
        new = solution.left_out[n]
        now = new.copy()
        now[GEOMETRY] = 0.0
        for k, p in enumerate((now, new)):
            for s, e in piece.residuals(p).items():
                at, e = problem.sensors.index(s), e[np.isfinite(e)]
                squares[k, n, at] = (np.minimum(np.abs(e), CAP * solution.sizes[s]) ** 2).sum()
                counts[n, at] = len(e)

    # A reading that is missed by less speaks neither for the new values nor against them.
    least = np.array([AGREES**2 if s == "tape" else 0.0 for s in problem.sensors])

    def gains(kept: Mask) -> Floats:
        floor = least * counts[kept].sum(axis=0) + TINY**2
        now, new = np.maximum(squares[:, kept].sum(axis=1), floor)
        return np.asarray(np.log(now / new) / 2)

    every = np.ones(len(problem.pieces), dtype=bool)
    gain = gains(every)
    others = [float(gains(np.arange(len(every)) != n).sum()) for n in range(len(every))]
    spread = math.sqrt(len(every) - 1) * float(np.std(others))
    rms = np.sqrt(squares.sum(axis=1) / np.maximum(1.0, counts.sum(axis=0)))
    errors = {s: Errors(*rms[:, k].tolist()) for k, s in enumerate(problem.sensors)}
    turns = {"gyro", "headings"} & set(problem.sensors)
    return Fit(
        base, solution.p, solution.covariance, tuple(problem.sensors), tuple(problem.pieces),
        solution.without, float(gain.sum()), spread, float(gain.min()),
        _turn_errors(problem, solution) if turns else None,
        errors.get("positions"), errors.get("tape"),
        bool({"positions", "tape"} & set(problem.sensors)), _tracked(problem, solution.p),
        gyro_std if _by_gyro_alone(problem) else 0.0, solution.halves,
    )  # fmt: skip


def _by_gyro_alone(problem: Problem) -> bool:
    tape = any(r.quantity == "turn" for piece in problem.pieces for r in piece.run.tape)
    return "gyro" in problem.sensors and not tape and {"gyro", "tape"} >= set(problem.sensors)


def _tracked(problem: Problem, p: Floats) -> bool:
    best = problem.sizes(p)
    moved = np.repeat(p[None], 2, axis=0)
    moved[:, TRACK] += OTHER_TRACK, -OTHER_TRACK
    return "tape" in problem.sensors or all(
        any(size > SHOWN * best[sensor] for sensor, size in problem.sizes(other).items())
        for other in moved
    )


def _heading_error(piece: Piece, p: Floats) -> float:
    # Return the sum of the errors of the turns between headings some seconds apart, rad.
    yaw_t, yaw = piece.run.yaw_t, piece.run.yaw
    steps = max(1, round(float(yaw_t[-1] - yaw_t[0]) / HEADING_STEP_S))
    at = np.searchsorted(yaw_t, np.linspace(yaw_t[0], yaw_t[-1], steps + 1))
    heading = piece.base.path(p, piece.left, piece.right)[1]
    off = np.diff(yaw[at] - np.interp(yaw_t[at] - p[POSE_DELAY], piece.t, heading))
    return float(np.abs(np.angle(np.exp(1j * off))).sum())


def _turn_errors(problem: Problem, solution: Solution) -> Errors:
    off, turned = np.zeros(2), 0.0
    for n, piece in enumerate(problem.pieces):
        new = solution.left_out[n]
        now = new.copy()
        now[GEOMETRY] = 0.0
        turned += float(np.abs(piece.base.motion(new, *piece.rolls)[1]).sum())
        for k, p in enumerate((now, new)):
            if piece.gyro:
                off[k] += float(np.nansum(np.abs(piece.residuals(p)["gyro"])))
            elif len(piece.run.yaw_t) > 1:
                off[k] += _heading_error(piece, p)
    return Errors(*(off * math.tau / max(turned, TINY)).tolist())
