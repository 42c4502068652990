"""Fits the noise of `[odometry]` to the runs that the fit of the geometry left out.

In windows of several lengths, the squared error of the heading, and of the distance, is a sum of
what each source gives: the rolled path, the turned angle, and the squares of both, which are errors
of ratio and track that last for a whole window. The shares are the non-negative least squares.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.fit import (
    AHEAD,
    ASIDE,
    BETTER_DEVIATIONS,
    BIAS,
    GYRO_DELAY,
    POSE_DELAY,
    SCALE,
    Fit,
    Piece,
    aligned,
)
from acsard.calibration.log import Run
from acsard.calibration.series import TINY, Complexes, Floats
from acsard.core.config.settings import OdometryConfig
from acsard.core.values import Seconds

WINDOWS_S = 2.0, 6.0, 30.0
POSITION_WINDOWS_S = 6.0, 12.0, 30.0  # of positions alone; they overlap by half
SHORTEST = 0.7  # of a window at the end of a run, as a fraction
MIN_WINDOWS, FOLDS = 20, 5
LEAST_ROLL_M, LEAST_WAY_M = 1e-3, 0.02
STRAIGHT = 0.8  # way / rolled path of a window that shows an error of the distance
OUTLIER = 9.0  # variances of a squared error, above which it counts as this
MEDIAN = 0.455  # of a chi-square of one degree of freedom, whose mean is 1
MAX_ANGLE = 0.2  # rad, that errors of positions may turn half a window
FLOOR = 1e-7  # of a variance per metre or radian

Row = list[float]
# Columns of the rows: what multiplies each variance, and the squared error.
ROLL, TURNED, TURN_SQUARED, ROLL_SQUARED, SENSOR, SQUARE = range(6)


class Noise(Struct, frozen=True):
    yaw_per_metre: float | None  # rad2/m
    yaw_per_radian: float | None  # rad2/rad
    track: float  # variance that lasts, of the track, as a fraction
    ratio: float  # variance that lasts, of the heading per metre rolled, rad2/m2
    distance_per_metre: float | None  # m2/m
    scale: float  # variance that lasts, of the distance, as a fraction
    heading_better: bool
    distance_better: bool


def noise(runs: Sequence[Run], fit: Fit, odometry: OdometryConfig, wheels: int = 4) -> Noise:
    """Return the noise that the runs of a fit show, and whether it describes them better."""
    headings, distances = _Rows(), _Rows()
    # Positions alone show the heading over long ways only, and so in whole runs.
    turns = {"gyro", "headings"} & set(fit.sensors)
    parts = [piece.run for piece in fit.pieces] if turns else runs
    whole, passed = sum(run.seconds for run in parts) + TINY, 0.0
    for run in parts:
        for begin, heading, distance in _windows(run, fit):
            group = int(FOLDS * (passed + begin - run.t[0]) / whole)
            headings.add(heading, group)
            distances.add(distance, group)
        passed += run.seconds
    track = fit.base.track * math.exp(fit.p[2])
    stated = np.array([
        odometry.yaw_variance_per_metre, odometry.yaw_variance_per_radian,
        (odometry.track_std(wheels) * fit.base.track / track) ** 2,
        (odometry.wheel_radius_ratio_std / track) ** 2, 0.0,
    ])  # fmt: skip
    by_heading, heading_better = _fitted(headings, stated)
    stated = np.array([
        odometry.distance_variance_per_metre, 0.0, 0.0, odometry.distance_scale_std**2, 0.0,
    ])  # fmt: skip
    by_distance, distance_better = _fitted(distances, stated)
    a, b, c, d = (float(v) for v in by_heading[:SENSOR])
    # Zeros mean that the errors of the sensor hide those of the wheels.
    known, seen = by_heading[:SENSOR].any(), by_distance[:SENSOR].any()
    return Noise(
        max(a, FLOOR) if known else None, max(b, FLOOR) if known else None, c, d,
        max(float(by_distance[ROLL]), FLOOR) if seen else None, float(by_distance[ROLL_SQUARED]),
        heading_better, distance_better,
    )  # fmt: skip


class _Rows:
    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.groups: list[int] = []

    def add(self, row: Row | None, group: int) -> None:
        if row is not None and all(map(math.isfinite, row)):
            self.rows.append(row)
            self.groups.append(group)


def _windows(run: Run, fit: Fit) -> Iterator[tuple[Seconds, Row | None, Row | None]]:
    whole, t = Piece(run, fit.base), run.t
    own = np.array(
        [(piece.run.name, piece.run.tape) == (run.name, run.tape) for piece in fit.pieces]
    )
    begins, ends = np.array([(piece.t[0], piece.t[-1]) for piece in fit.pieces]).T
    alone = not (whole.gyro or len(run.yaw_t))
    for length in POSITION_WINDOWS_S if alone else WINDOWS_S:
        if t[-1] - t[0] < SHORTEST * min(length, WINDOWS_S[1]):
            continue
        length = min(length, float(t[-1] - t[0]))
        step = length / 2 if alone else length
        for begin in np.arange(t[0], t[-1] - SHORTEST * length, step):
            edges = np.array([begin, min(begin + length, t[-1])])
            p = fit.without(own & (begins < edges[1]) & (ends > begin))
            path = Path(whole, p)
            row = far = None
            if whole.gyro:
                late = edges + p[GYRO_DELAY]
                seen = np.diff(np.interp(late, run.gyro_t, run.turned) - p[BIAS] * late)[0]
                row = _heading(path, edges, seen * math.exp(p[SCALE]))
            elif len(run.yaw_t):
                # At the samples themselves: between them, the heading is unknown.
                at = _nearest(run.yaw_t, edges + p[POSE_DELAY])
                row = _heading(path, run.yaw_t[at] - p[POSE_DELAY], np.diff(run.yaw[at])[0])
            if len(run.place_t) > 2:
                at = _nearest(run.place_t, edges + p[POSE_DELAY])
                far = _distance(path, run.place_t[at] - p[POSE_DELAY], np.diff(run.place[at])[0])
                if alone:
                    inside = slice(*at)
                    row = _bend(path, run.place_t[inside] - p[POSE_DELAY], run.place[inside])
            yield float(begin), row, far


class Path:
    """The path by the wheels: positions of the sensor, headings, and what was rolled and turned."""

    def __init__(self, piece: Piece, p: Floats) -> None:
        place, heading = piece.base.path(p, piece.left, piece.right)
        distance, turn = piece.base.motion(p, np.diff(piece.left), np.diff(piece.right))
        place = place + (p[AHEAD] + 1j * p[ASIDE]) * np.exp(1j * heading)
        rolled, turned = (np.concatenate(([0.0], np.cumsum(np.abs(v)))) for v in (distance, turn))
        self._t, self._columns = piece.t, (heading, rolled, turned, place.real, place.imag)

    def at(self, t: Floats) -> tuple[Floats, ...]:
        """Return heading, rolled, turned, x and y at these times."""
        return tuple(np.interp(t, self._t, column) for column in self._columns)


def _nearest(t: Floats, at: Floats) -> npt.NDArray[np.int64]:
    return np.searchsorted((t[1:] + t[:-1]) / 2, at)


def _heading(path: Path, t: Floats, seen: float) -> Row | None:
    way, roll, spin = (float(np.diff(v)[0]) for v in path.at(t)[:3])
    off = math.remainder(seen - way, math.tau)
    return [roll, spin, way**2, roll**2, 1.0, off**2] if roll > LEAST_ROLL_M else None


def _bend(path: Path, t: Floats, seen: Complexes) -> Row | None:
    # The turn of the positions from the first to the second half of a window, beside that of the
    # wheels. An error of the heading turns all later positions about the place where it happens.
    if len(t) < 8:
        return None
    heading, rolled, turned, x, y = path.at(t)
    model = x + 1j * y
    middles = (model[1:] + model[:-1]) / 2
    off, sensor, share = 0.0, 0.0, np.zeros(len(middles))
    for sign, half in ((-1, slice(None, len(t) // 2)), (1, slice(len(t) // 2, None))):
        found = aligned(seen[half], model[half])
        weight = found.weight
        arms = np.zeros(len(t), complex)
        arms[half] = weight * (model[half] - weight @ model[half] / weight.sum()).conj()
        square = float((np.abs(arms[half]) ** 2 / weight).sum())
        if square <= 0.0 or np.median(np.abs(found.off)) > MAX_ANGLE * math.sqrt(square):
            return None
        later = [np.cumsum(v[::-1])[::-1][1:] for v in (arms * model, arms)]
        share += sign * (later[0] - middles * later[1]).real / square
        off += sign * cmath.phase(found.turn)
        sensor += 1 / square
    roll, spin, way = (np.diff(v) for v in (rolled, turned, heading))
    return [
        float(share**2 @ roll), float(share**2 @ spin), float(share @ way) ** 2,
        float(share @ roll) ** 2, sensor, math.remainder(off, math.tau) ** 2,
    ]  # fmt: skip


def _distance(path: Path, t: Floats, chord: complex) -> Row | None:
    _, (begin, end), _, x, y = path.at(t)
    way, roll = float(np.hypot(np.diff(x), np.diff(y))[0]), float(end - begin)
    if way <= max(LEAST_WAY_M, STRAIGHT * roll):
        return None
    return [roll, 0.0, 0.0, roll**2, 1.0, (abs(chord) - way) ** 2]


def _fitted(rows: _Rows, stated: Floats) -> tuple[Floats, bool]:
    # Return the variances of the sources, and whether they are better than the `stated` ones.
    # They are fitted without each fifth of the log in turn, and compared on this fifth: better is a
    # likelihood that is larger by two of its standard deviations.
    if len(rows.rows) <= MIN_WINDOWS:
        return np.zeros(SQUARE), False
    table, group = np.array(rows.rows), np.array(rows.groups)
    variances = _solved(table)
    gains = []
    for number in range(FOLDS):
        out = group == number
        if out.any() and not out.all():
            new = _solved(table[~out])
            features, squares = table[out, :SQUARE], table[out, SQUARE]
            sensor = features[:, SENSOR] * new[SENSOR]
            gains.append(
                _likelihood(squares, features @ new)
                - _likelihood(squares, features @ stated + sensor)
            )
    total = np.array(gains)
    return variances, bool(
        total.sum() > BETTER_DEVIATIONS * math.sqrt(len(total)) * float(np.std(total))
    )


def _likelihood(squares: Floats, variances: Floats) -> float:
    variances = np.maximum(variances, 1e-14)
    return float(-(np.log(variances) + np.minimum(squares / variances, 25.0)).sum() / 2)


def _solved(table: Floats) -> Floats:
    features, squares = table[:, :SQUARE], table[:, SQUARE]
    scale = features.max(axis=0) + 1e-30
    features, seen = features / scale, squares
    weight = np.full(len(squares), 1 / (float(np.median(squares)) + 1e-12))
    for _ in range(8):
        shares = _non_negative(features * weight[:, None], seen * weight)
        expected = features @ shares + 1e-14
        expected *= float(np.median(squares / expected)) / MEDIAN
        weight, seen = 1 / (expected + 1e-14), np.minimum(squares, OUTLIER * expected)
    shares = _non_negative(features * weight[:, None], seen * weight)
    return np.asarray(np.where(scale > 1e-20, shares / scale, 0.0))


def _non_negative(features: Floats, values: Floats) -> Floats:
    normal, score = features.T @ features, features.T @ values
    x = np.full(len(score), 1e-12)
    for _ in range(200):
        for i in np.flatnonzero(np.diag(normal) > 0):
            x[i] = max(0.0, x[i] + (score[i] - normal[i] @ x) / normal[i, i])
    return np.asarray(x)
