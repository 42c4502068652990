"""Compares each sensor alone with the wheels, by the rows of one table.

A row is the wheels as they are, with another scale or sign of one side, or with columns of another
meaning. Each row is tried on one grid of delays (and of tracks, for positions), with the turns to
either side. A row that is not the given one must explain the sensor clearly better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.geometry import Base, path
from acsard.calibration.log import Run
from acsard.calibration.series import TINY, Complexes, Floats, Mask
from acsard.core.values import Seconds

STEP_S, WINDOW_S, GRID_S = 1.0, 10.0, 0.05  # of turns, of positions, and of the wheels' path
MIN_SPOTS, MAX_SPOTS = 10, 2000  # positions of a window, and of a log
SEARCH_S = 200.0  # of the parts that are searched
APART_S = 60.0  # between two runs on their common axis of time
MIN_ROLL, LEAST_TURN = 0.02, 1e-3  # rad, in a step that shows something
HUBER = 1.5  # usual sizes, beyond which an error counts less
BIAS_STD, REST_BIAS_STD, MIN_RESTS = 0.05, 1e-3, 20  # rad/s, of a gyro without and with rests
CAP = 0.5  # rad, beyond which a turn counts as not explained
HOLE_S, HOLE_PERIODS = 0.5, 8.0  # a hole in the samples of a sensor is longer than both
LEVER = 1e-3  # weight of the lever of a sensor, which is small

TRACKS, WIDE_TRACKS = (np.geomspace(*span, 66) for span in ((0.3, 4.0), (0.01, 1000.0)))
FINE = np.linspace(0.95, 1.05, 21)  # of the best track
DELAYS_S, WIDE_DELAYS_S = np.linspace(-1.0, 1.0, 21), np.linspace(-8.0, 8.0, 65)
DELAY_COST = 1e-3  # for each second: of equal delays, the least one counts
LATE_S = 0.9
RATIOS = -1.0, 2.0, 0.5, 4.0, 0.25  # of the left side, that positions are compared with
SAME_SIDES = 0.8, 1.25  # ratios of the sides that are no mistake
ROUNDS = 12  # of the weights of the least absolute values

FOLLOWS = 0.3  # share of a sensor's motion that the wheels need not explain
# A row that is not the given one with a possible robot must leave less than half unexplained.
CLEARER, CLEAR = 2.0, 0.02
ROBOTS = 0.8, 3.6  # effective track / wheel separation

BAD, BAD_TURN, BAD_WAY_M, MAX_BAD = 0.9, 0.15, 0.1, 0.4  # of a window that is left out
OVERFLOWS, USUAL = 3.0, 0.9  # of this quantile of the steps of a running count

COLUMNS = {
    "gyro": ("gyro_t", "turned", "rate"), "headings": ("yaw_t", "yaw"),
    "positions": ("place_t", "place"),
}  # fmt: skip


def weights(off: Floats, size: float) -> Floats:
    """Return the weights of errors whose usual size is `size`; larger ones count less."""
    return np.asarray(np.minimum(1.0, (HUBER * size + TINY) / (np.abs(off) + TINY)))


def _unwrapped(integral: Floats, t: Floats) -> Floats:
    steps = np.diff(np.gradient(integral, t), prepend=0.0)
    wild = np.abs(steps) > OVERFLOWS * np.quantile(np.abs(steps), USUAL)
    return np.asarray(np.cumsum(np.where(wild, 0.0, steps)))


# Other meanings of the columns. If they are angles, the angle is what was integrated.
ROWS: dict[str, Callable[[Run], Run]] = {
    "angles": lambda run: replace(
        run, left=_unwrapped(run.left, run.t), right=_unwrapped(run.right, run.t)
    ),
    "degrees": lambda run: replace(run, yaw=np.radians(run.yaw)),
}

Span = tuple[int, Seconds, Seconds]  # a part of a log: index of the run, begin and end


class Match(Struct, frozen=True):
    """What a sensor shows of the wheels, if one row of the table is right."""

    sensor: str
    unexplained: float  # share of the sensor's motion, without the bad windows
    track: float  # turn by the wheels / by the sensor, as configured; negative to the other side
    delay: Seconds
    raw: float  # unexplained share with the bad windows, and with turns that only the wheels show
    ratio: float = 1.0  # by which left must be multiplied beside right
    size: float = 1.0  # distance by positions / by the wheels, as configured
    lever: tuple[float, float] = (0.0, 0.0)  # of the sensor, ahead and to the left, m
    bad: tuple[Span, ...] = ()
    row: str = ""  # a key of ROWS
    as_given: float = 0.0  # unexplained share by the given row, with turns to the given side

    @property
    def follows(self) -> bool:
        return self.unexplained < FOLLOWS

    @property
    def given(self) -> bool:
        return not self.row and self.ratio == 1.0 and self.track > 0

    @property
    def cost(self) -> float:
        return float(cost(self.raw, self.track if self.given else 0.0, self.delay))


def cost(share: float | Floats, track: float | Floats, delay: float | Floats) -> Floats:
    """Return by how much a row explains less than others. A possible robot has a head start."""
    possible = (np.asarray(track) > ROBOTS[0]) & (np.asarray(track) < ROBOTS[1])
    return np.where(possible, share, CLEARER * share + CLEAR) + DELAY_COST * np.abs(delay)


def sensors(runs: Sequence[Run]) -> list[str]:
    return [s for s, (t, *_) in COLUMNS.items() if any(len(getattr(run, t)) > 2 for run in runs)]


def without(run: Run, *left_out: str) -> Run:
    """Return the run without these sensors."""
    empty = {name: getattr(run, name)[:0] for sensor in left_out for name in COLUMNS[sensor]}
    return replace(run, **empty)


def gyro_bias(runs: Sequence[Run]) -> tuple[float, float]:
    """Return the rate that the gyro shows while the wheels rest, and its deviation, rad/s."""
    rest = np.concatenate([run.rate[run.rests(run.gyro_t)] for run in runs])
    known = len(rest) > MIN_RESTS
    return (float(np.median(rest)), REST_BIAS_STD) if known else (0.0, BIAS_STD)


def matched(sensor: str, runs: Sequence[Run], base: Base) -> Match:
    """Return the row of the table that fits a sensor: the given one, unless another is clearer."""
    kind = Places if sensor == "positions" else Turns
    seen = kind(sensor, runs, base)
    found = [seen.match()]
    if found[0].cost > CLEAR:
        found += seen.uneven()
    best = min(found, key=lambda match: match.cost)
    if not (best.follows and abs(best.delay) < LATE_S):
        found.append(seen.match(wide=True))
        for row in ("angles", *["degrees"] * (sensor == "headings")):
            match = kind(sensor, list(map(ROWS[row], runs)), base).match(wide=True)
            found.append(replace(match, row=row))
        best = min(found, key=lambda match: match.cost)
    return replace(best if best.follows else found[0], as_given=found[0].as_given)


class Comparison:
    """One sensor beside the wheels: all runs on one axis of time, in steps and in windows."""

    def __init__(self, sensor: str, runs: Sequence[Run], base: Base) -> None:
        self.sensor, self.base = sensor, base
        self.shift = np.cumsum([0.0, *(run.t[-1] + APART_S for run in runs[:-1])])
        made: dict[str, Floats | Complexes] = {
            name: np.concatenate(
                [getattr(run, name) + at for run, at in zip(runs, self.shift, strict=True)]
            )
            for name in ("t", "gyro_t", "place_t", "yaw_t")
        }
        for name in ("left", "right", "turned"):
            parts, last = [np.zeros(0)], 0.0
            for values in [getattr(run, name) for run in runs if len(getattr(run, name))]:
                parts.append(values - values[0] + last)
                last = float(parts[-1][-1])
            made[name] = np.concatenate(parts)
        made |= {n: np.concatenate([getattr(r, n) for r in runs]) for n in ("place", "yaw")}
        self.run = replace(runs[0], **made)
        # Few positions fit any wheels, because each window is turned and moved.
        steps = np.diff(self.run.place_t)
        self.window_s = max(WINDOW_S, MIN_SPOTS * float(np.median(steps)) if len(steps) else 0.0)
        self.begin, self.end = self._edges(runs, STEP_S)
        self.windows = self._edges(runs, self.window_s)

    def _edges(self, runs: Sequence[Run], step: Seconds) -> tuple[Floats, Floats]:
        edges = [run.edges(step) + shift for run, shift in zip(runs, self.shift, strict=True)]
        return np.concatenate([e[:-1] for e in edges]), np.concatenate([e[1:] for e in edges])

    def window(self, t: Floats) -> npt.NDArray[np.int64]:
        return np.asarray(np.maximum(np.searchsorted(self.windows[0], t + TINY) - 1, 0))

    def rolled(self, begin: Floats, end: Floats) -> Floats:
        """Return the distances that the left and the right wheels roll, m."""
        return np.array([
            radius * (np.interp(end, self.run.t, side) - np.interp(begin, self.run.t, side))
            for radius, side in ((self.base.left, self.run.left), (self.base.right, self.run.right))
        ])  # fmt: skip

    def rolls(self, begin: Floats, end: Floats) -> Mask:
        rolled = np.abs(self.rolled(begin, end)).sum(axis=0)
        return np.asarray(rolled > MIN_ROLL * self.base.left)

    def judged(
        self, t: Floats, off: Floats, moved: Floats, rolls: Mask, least: float
    ) -> tuple[float, tuple[Span, ...]]:
        """Return the unexplained share of the motion without the bad windows, and these."""
        window, known = self.window(t), np.isfinite(off + moved)

        def sums(values: Floats, mask: Mask) -> Floats:
            counted = np.bincount(window[mask], values[mask], minlength=len(self.windows[0]))
            return np.asarray(counted, dtype=np.float64)

        bad = sums(off - least, known) > 0
        bad &= sums(off - BAD * moved, known) > 0
        off, moved = (sums(values, known & rolls) for values in (off, moved))
        if bad.sum() > MAX_BAD * (bad | (moved > 0)).sum():
            bad[:] = False
        share = np.clip(off, 0.0, moved)[~bad].sum() / max(TINY, float(moved[~bad].sum()))
        run = np.searchsorted(self.shift, self.windows[0], side="right") - 1
        begin, end = (edge - self.shift[run] for edge in self.windows)
        spans = zip(run[bad].tolist(), begin[bad].tolist(), end[bad].tolist(), strict=True)
        return float(share), tuple(spans)


class Turns(Comparison):
    """The turns by a gyro or by headings, in steps."""

    def __init__(self, sensor: str, runs: Sequence[Run], base: Base) -> None:
        super().__init__(sensor, runs, base)
        self.t, self.values = self.run.yaw_t, np.unwrap(self.run.yaw)
        if sensor == "gyro":
            self.t, self.values = self.run.gyro_t, self.run.turned
        steps = np.diff(self.t)
        holes = steps > max(HOLE_S, HOLE_PERIODS * float(np.median(steps)))
        self.holes = np.concatenate(([0], np.cumsum(holes)))
        self.moving = self.rolls(self.begin, self.end)

    def seen(self, delay: Seconds) -> Floats:
        begin, end = self.begin + delay, self.end + delay
        first = np.searchsorted(self.t, begin, side="right") - 1
        last = np.searchsorted(self.t, end)
        inside = (first >= 0) & (last < len(self.t))
        first, last = np.maximum(first, 0), np.minimum(last, len(self.t) - 1)
        turned = np.interp(end, self.t, self.values) - np.interp(begin, self.t, self.values)
        return np.where(inside & (self.holes[first] == self.holes[last]), turned, np.nan)

    def match(self, *, even: bool = True, wide: bool = False) -> Match:
        """Return the least absolute values of the turns beside those by the wheels.

        A gyro has a bias, too. Both sides count alike if they are `even`.
        """
        left, right = self.rolled(self.begin, self.end) / self.base.track
        bias = (self.sensor == "gyro") * (self.end - self.begin)
        columns = np.array([right - left, bias] if even else [right, -left, bias])
        delays = np.append(DELAYS_S, WIDE_DELAYS_S) if wide else DELAYS_S
        seen = np.array([self.seen(delay) for delay in delays])
        known = np.isfinite(seen)
        y, weight = np.where(known, seen, 0.0), known.astype(float)
        ridge = np.diag([*[TINY] * (len(columns) - 1), 1e-3])
        for _ in range(ROUNDS):
            normal = np.einsum("dn,in,jn->dij", weight, columns, columns)
            normal += ridge * (1 + weight.sum(axis=1))[:, None, None]
            score = np.einsum("dn,in,dn->di", weight, columns, y)
            shares = np.linalg.solve(normal, score[:, :, None])[:, :, 0]
            off = np.abs(y - shares @ columns)
            weight = known / np.maximum(off, LEAST_TURN)
        mean = shares[:, :-1].mean(axis=1)
        tracks = 1 / np.where(np.abs(mean) > 1e-6, mean, 1e-6)
        moved = np.abs(y - shares[:, -1:] * bias)
        used = known & self.moving
        off, most = (np.minimum(values, CAP) * used for values in (off, moved))
        share = np.minimum(off.sum(axis=1) / (most.sum(axis=1) + TINY), 1.0)
        # A step that the delay loses is not explained.
        share = 1 - (1 - share) * used.sum(axis=1) / max(1, int(self.moving.sum()))
        at = int(np.argmin(cost(share, tracks, delays)))
        track, delay, raw = (float(values[at]) for values in (tracks, delays, share))
        wheels = np.where(self.moving, columns[:-1].T @ shares[at, :-1], 0.0)
        off = np.abs(y[at] - shares[at, -1] * bias - wheels)
        off = np.where(known[at], off, np.minimum(moved[at], BAD_TURN))
        judged, bad = self.judged(self.begin, off, moved[at], self.moving, BAD_TURN)
        ratio = 1.0 if even else float(shares[at, 1] / (shares[at, 0] or TINY))
        as_given = judged if track > 0.0 else 1.0
        return Match(
            self.sensor, judged, track, delay, raw, ratio, bad=bad, as_given=as_given
        )  # fmt: skip

    def uneven(self) -> list[Match]:
        found = self.match(even=False)
        return [] if SAME_SIDES[0] < found.ratio < SAME_SIDES[1] else [found]


class Places(Comparison):
    """Positions, in windows of which each is turned and moved onto the path of the wheels."""

    def __init__(self, sensor: str, runs: Sequence[Run], base: Base) -> None:
        super().__init__(sensor, runs, base)
        every = max(1, len(self.run.place_t) // MAX_SPOTS)
        self.t, self.place = self.run.place_t[::every], self.run.place[::every]
        window = self.window(self.t)
        self.first = np.flatnonzero(np.diff(window, prepend=-1))
        self.part = np.cumsum(np.diff(window, prepend=-1) != 0) - 1
        edges = [run.edges(GRID_S) + shift for run, shift in zip(runs, self.shift, strict=True)]
        self.grid = np.concatenate(edges)
        between = self.run.place[1:-1] - (self.run.place[2:] + self.run.place[:-2]) / 2
        self.noise = float(np.median(np.abs(between))) / math.sqrt(1.5)
        self.rolling = self.rolled(self.grid[:-1], self.grid[1:])
        # A part of a long log suffices for the search.
        every = int(sum(run.seconds for run in runs) / SEARCH_S)
        parts = [run.part(a, a + self.window_s) for run in runs
                 for a in np.arange(run.t[0], run.t[-1] - STEP_S, self.window_s)]  # fmt: skip
        self.few = Places(sensor, parts[::every], base) if 1 < every < len(parts) / 3 else self

    def fitted(self, ratio: float, track: float, delay: Seconds) -> tuple[float, Floats, Floats]:
        """Return the unexplained share, size of the wheels and lever, and each error, m."""
        a, b = self.rolling * [[ratio], [1.0]]
        place, heading = path((a + b) / 2, (b - a) / (self.base.track * track))
        at = self.t - delay
        model = np.interp(at, self.grid, place.real) + 1j * np.interp(at, self.grid, place.imag)
        lever = np.exp(1j * np.interp(at, self.grid, heading))
        weight, turned = np.ones(len(at)), model
        for _ in range(3):
            seen, m, e, turned = (
                v - (np.add.reduceat(weight * v, self.first)
                     / np.add.reduceat(weight, self.first))[self.part]
                for v in (self.place, model, lever, turned)
            )  # fmt: skip
            turn = np.add.reduceat(weight * seen * turned.conj(), self.first)
            turn = np.where(np.abs(turn) > TINY, turn, 1.0)  # of wheels that stand
            back = seen * (turn / np.abs(turn)).conj()[self.part]
            columns = np.array([m, e, 1j * e])
            # The threads of a matrix product cost more than they save here.
            normal = np.einsum("in,n,jn->ij", columns.conj(), weight, columns).real
            normal += np.diag([TINY, LEVER * len(at), LEVER * len(at)])
            score = np.einsum("in,n,n->i", columns.conj(), weight, back).real
            x = np.linalg.solve(normal, score)
            turned = x[0] * m + (x[1] + 1j * x[2]) * e
            off = np.abs(back - turned)
            weight = weights(off, float(np.median(off)))
        wrong, moved = (np.add.reduceat(v, self.first) for v in (off, np.abs(seen)))
        return float(np.minimum(wrong, moved).sum() / max(TINY, moved.sum())), x, off

    def match(self, ratio: float = 1.0, *, wide: bool = False) -> Match:
        few = self.few

        def best(tracks: Floats, delays: Floats) -> tuple[float, float, float]:
            return min(
                (float(cost(few.fitted(ratio, track, delay)[0], track, delay)), track, delay)
                for track in tracks.tolist() for delay in delays.tolist()
            )  # fmt: skip

        tracks = np.outer((1.0, -1.0), WIDE_TRACKS if wide else TRACKS).ravel()
        found = best(tracks, np.zeros(1))
        if wide:
            found = min(found, best(np.outer((1.0, -1.0), TRACKS[::3]).ravel(), WIDE_DELAYS_S))
        _, track, delay = found
        _, _, delay = best(np.array([track]), delay + DELAYS_S)
        _, track, _ = best(np.append(tracks, track * FINE), np.array([delay]))
        raw, (size, ahead, aside), off = self.fitted(ratio, track, delay)
        moved = np.abs(self.place - (np.add.reduceat(self.place, self.first)
                                     / np.bincount(self.part))[self.part])  # fmt: skip
        rolls = self.rolls(self.t - STEP_S / 2, self.t + STEP_S / 2)
        share, bad = self.judged(self.t, off - self.noise, moved, rolls, BAD_WAY_M)
        if not tracks.min() < track < tracks.max():
            share = max(share, FOLLOWS)  # the best track is none of a robot
        lever = float(ahead), float(aside)
        as_given = share if track > 0.0 else self.fitted(ratio, -track, delay)[0]
        return Match(
            self.sensor, share, track, delay, raw, ratio, float(size), lever, bad,
            as_given=as_given,
        )  # fmt: skip

    def uneven(self) -> list[Match]:
        return [self.match(ratio) for ratio in RATIOS]
