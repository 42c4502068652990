"""Fits the noise of `[odometry]` to drives that the fit of the geometry did not use.

A window is about half a minute of a drive. Its residuals are the headings or the positions of a
sensor minus those of the wheels, at times that lie seconds apart. An error that lasts for a turn,
like that of a track that changes with the turn rate, thus counts as much as over a whole drive. The
residuals are modelled as normal with mean 0. Their covariance is linear in the noise (`Source`, x
below), with a matrix C_i for each source of errors, and K for the known errors of the geometry:

    V = K + sum over i of x_i C_i

The start of the window, and its heading if only positions are measured, are unknown and are
projected out (restricted maximum likelihood: Patterson & Thompson, Biometrika 58, 1971). The steps
of Zhou, Hu, Qiao, Cho & Zhou (MM Algorithms for Variance Components Models, 2019) find x. The sums
are over the windows, and no x_i becomes negative:

    x_i <- x_i sqrt(sum of r' V^-1 C_i V^-1 r / sum of tr(V^-1 C_i))
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.fit import Base, P, student_factor
from acsard.calibration.heading import Heading, Headings
from acsard.calibration.improvement import SURE, Fold, positions_of, with_chance
from acsard.calibration.log_table import Floats
from acsard.calibration.multipliers import Deviations
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.calibration.positions import Path, WheelSteps, path
from acsard.calibration.runs import Complexes, Mask, Run, inside
from acsard.core.config.settings import OdometryConfig


class Source(IntEnum):
    """Indices of the noise by its source. Up to `TRACK` it is the robot's, then the sensors'."""

    DISTANCE = 0
    """Variance of the distance per metre, m."""
    YAW = 1
    """Variance of the heading per metre that a side rolls, rad2/m."""
    SKID = 2
    """Variance of the heading per radian turned, rad."""
    SLIP = 3
    """Square of the share of each distance that is lost for a whole window."""
    RATIO = 4
    """Square of the ratio of both radii, as it changes from window to window."""
    TRACK = 5
    """Square of the share by which the track changes from window to window."""
    HEADING = 6
    """Variance of a measured heading, rad2."""
    DRIFT = 7
    """Variance of the gyro's heading per second, rad2/s."""
    PLACE = 8
    """Variance of a measured coordinate, m2."""


COUNT = len(Source)
SENSORS = np.arange(COUNT) > Source.TRACK
RATES = np.arange(COUNT) < Source.SLIP
START = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-6, 1e-4, 1e-5, 1e-6, 1e-4])
"""Noise from which the search starts. It only has to be positive."""

WINDOW_S, APART_S = 32.0, 4.0
"""Length of a window and time between its residuals, s. A shorter drive is one window."""

LEAST = 4
"""Smallest number of times in a window."""

MOST_WINDOWS = 80
"""Number of windows that are enough, spread over the log."""

FINE_S = 0.5
"""Length of the steps in which the errors arise, s."""

MOST_FOLDS = 10
"""Number of groups of drives of which each is left out once. Each costs two searches."""

STEPS, FEWER_STEPS = 150, 60
"""Number of steps of a search, and of one that starts from the noise of the whole log."""

OUTLIER = 9.0
"""Mean square of a window's residuals, in variances, beyond which the window counts less."""

ROUNDING = 1e-12
"""Variance that is added to each residual, so that a perfect sensor has a covariance."""

FLOOR = 0.25
"""Smallest variance rate that is given, in its own standard deviations.

A log of a minute often explains everything by the geometry and leaves a rate of 0. The covariance
of the pose would then claim that some directions have no error at all.
"""

CHANGES = 0.1
"""Smallest variance rate, as a fraction of the one that would replace the noise that lasts.

No window shows how long an error lasts beyond its end. Without this rate, one robot of eight had a
covariance without width.
"""

TWICE = math.log(2.0) - 3 / 8
"""Gain that is sure whatever its standard deviation is.

A residual loses this likelihood if its stated standard deviation is twice the true one.
"""

MOST = 1.0
"""Largest setting that is given. The configuration accepts it for a rate and for a deviation."""

METRES = 10.0
"""Distance for which the uncertainty is reported, m."""


class Windows(Struct, frozen=True):
    """Windows with n residuals each. Smaller ones are filled up with residuals without effect."""

    drive: npt.NDArray[np.int64]
    """Number of the drive of each window."""
    size: Floats
    """Number of true residuals of each window."""
    residual: Floats
    """Residuals without the start of the window, shape (windows, n)."""
    effects: Floats
    """The matrices C_i, shape (windows, COUNT, n, n)."""
    known: Floats
    """The matrix K, shape (windows, n, n)."""
    lasting: Floats
    """Rate of `DISTANCE`, `YAW` and `SKID` that has the effect of lasting noise over a window.

    These are the ratios to `SLIP`, `RATIO` and `TRACK` in a mean window.
    """

    def of(self, chosen: Mask | npt.NDArray[np.int64]) -> Windows:
        """Return some of the windows."""
        return Windows(
            self.drive[chosen], self.size[chosen], self.residual[chosen], self.effects[chosen],
            self.known[chosen], self.lasting,
        )  # fmt: skip

    def covariance(self, noise: Floats) -> Floats:
        """Return the covariance matrix of the residuals of each window, for this noise."""
        return np.asarray(np.tensordot(self.effects, noise, (1, 0)) + self.known)

    def search(self, start: Floats, free: Mask, steps: int = STEPS) -> Floats:
        """Return the noise that explains the windows best. Noise that is not `free` stays."""
        noise, flat = start.copy(), np.moveaxis(self.effects, 1, 0).reshape(COUNT, -1)
        for _ in range(steps):
            inverse = np.linalg.inv(self.covariance(noise))
            scores = np.einsum("wij,wj->wi", inverse, self.residual)
            squares = np.einsum("wi,wi->w", scores, self.residual)
            weight = np.minimum(1.0, OUTLIER * self.size / np.maximum(squares, 1e-300))
            seen = flat @ np.einsum("w,wi,wj->wij", weight, scores, scores).ravel()
            expected = flat @ inverse.ravel()
            used = free & (expected > 0.0)
            noise[used] *= np.sqrt(seen[used] / expected[used])
        return noise

    def at_least(self, noise: Floats) -> Floats:
        """Return the noise for another drive, with rates of at least `FLOOR` and `CHANGES`.

        Noise that a few residuals show is widened like the variance of Student's t. Windows overlap
        by half, so each residual counts half.
        """
        shares = np.linalg.inv(self.covariance(noise))[:, None] @ self.effects
        free = noise * np.einsum("wkii->k", shares) / 2
        noise = np.where(RATES, noise * student_factor(free), noise)
        information = np.einsum("wkij,wkji->k", shares, shares) / 2
        least = np.where(information > 0.0, FLOOR / np.sqrt(np.maximum(information, 1e-300)), 0.0)
        least[Source.SLIP :] = 0.0
        lasting = noise[[Source.SLIP, Source.RATIO, Source.TRACK]]
        least[: Source.SLIP] = np.maximum(least[: Source.SLIP], CHANGES * self.lasting * lasting)
        return np.asarray(np.maximum(noise, least))

    def likelihood(self, noise: Floats) -> Floats:
        """Return the logarithm of the likelihood of each window, without its constant."""
        covariance = self.covariance(noise)
        solved = np.linalg.solve(covariance, self.residual[:, :, None])[:, :, 0]
        squares = np.einsum("wi,wi->w", solved, self.residual)
        squares = np.minimum(squares, OUTLIER * self.size)
        return np.asarray(-(np.linalg.slogdet(covariance)[1] + squares) / 2)


class Noise(Struct, frozen=True):
    """The noise of the odometry as a log shows it, and whether it describes other drives better."""

    found: Floats
    present: Floats
    """The configured noise."""
    gain: float
    """Gain of likelihood of a residual in drives that the fit did not use, as a logarithm."""
    chance: float
    """Standard deviation of `gain` by the differences of the drives, as that of Student's t."""
    places: bool
    """Whether positions show the noise of the distance."""
    turning: float
    """Turn per metre in this log, rad/m."""
    track: float
    """Effective track, m."""

    @property
    def better(self) -> bool:
        """Whether the noise describes other drives better by more than chance explains."""
        return self.gain > min(SURE * self.chance, TWICE)

    def heading(self) -> tuple[float, float]:
        """Return the uncertainty of the heading by noise after `METRES`, rad, now and then."""
        return self._after(Source.YAW, Source.RATIO, Source.SKID)

    def distance(self) -> tuple[float, float]:
        """Return the uncertainty of the distance by noise after `METRES`, m, now and then."""
        return self._after(Source.DISTANCE, Source.SLIP, None)

    def _after(self, rate: Source, lasting: Source, skid: Source | None) -> tuple[float, float]:
        now, then = (
            math.sqrt(
                METRES * (x[rate] + (self.turning * x[skid] if skid is not None else 0.0))
                + METRES**2 * x[lasting] / (self.track**2 if skid is not None else 1.0)
            )
            for x in (self.present, self.found)
        )
        return now, then


def settings(
    known: Deviations, track: float, kept: Collection[str], odometry: OdometryConfig,
    shown: Noise | None = None, *, scaled: bool,
) -> dict[str, float]:  # fmt: skip
    """Return the settings of `[odometry]` that a calibration gives.

    Args:
        known: the standard deviations of the new geometry.
        track: the new multiplier of the wheel separation.
        kept: the quantities that stay as configured. Their deviations stay too.
        odometry: the present settings.
        shown: the noise, or None if it stays as configured.
        scaled: whether the size of the wheels was measured.
    """
    found, x = {}, np.zeros(COUNT) if shown is None else shown.found
    if TRACK not in kept or shown is not None:
        std = math.hypot(known.track, math.sqrt(x[Source.TRACK]))
        found["wheel_separation_multiplier_std"] = track * std
    if RATIO not in kept or shown is not None:
        found["wheel_radius_ratio_std"] = math.hypot(known.ratio, math.sqrt(x[Source.RATIO]))
        # The ratio's deviation takes the place of these two.
        for side in ("left_wheel_radius_multiplier_std", "right_wheel_radius_multiplier_std"):
            if getattr(odometry, side):
                found[side] = 0.0
    if scaled:
        found["distance_scale_std"] = known.scale
    if shown is not None:
        found["yaw_variance_per_metre"] = float(x[Source.YAW])
        found["yaw_variance_per_radian"] = float(x[Source.SKID])
        if shown.places:
            found["distance_variance_per_metre"] = float(x[Source.DISTANCE])
            found["wheel_slip_std"] = math.sqrt(x[Source.SLIP])
    return {name: min(value, MOST) for name, value in found.items()}


class Reference(Struct, frozen=True):
    """The sensors of a log, and the parameters of the fit that belong to them."""

    runs: Sequence[Run]
    headings: Headings | None
    places: bool
    steps: Sequence[WheelSteps]
    """The wheel steps of each run."""
    base: Base
    parameters: Floats


def noise(
    held: Sequence[Fold], seen: Reference, known: Deviations, odometry: OdometryConfig
) -> Noise | None:
    """Return the noise, or None if the log has too few drives or windows.

    Args:
        held: the drives, with the parameters that were found without them.
        seen: the sensors.
        known: the standard deviations of these parameters.
        odometry: the present settings.
    """
    motions: list[_Motion] = []
    windows = _windows(held, seen, known, motions)
    if windows is None or len(np.unique(windows.drive)) < 2:
        return None
    present = START.copy()
    present[: Source.HEADING] = (
        odometry.distance_variance_per_metre, odometry.yaw_variance_per_metre,
        odometry.yaw_variance_per_radian, odometry.wheel_slip_std**2, 0.0, 0.0,
    )  # fmt: skip
    every = np.ones(COUNT, dtype=bool)
    found = windows.search(START, every)
    by_present = windows.search(present, SENSORS)
    gains: list[tuple[float, float]] = []
    fold = np.unique(windows.drive, return_inverse=True)[1] % MOST_FOLDS
    for number in range(fold.max() + 1):
        out = fold == number
        rest, tested = windows.of(~out), windows.of(out)
        then = rest.at_least(rest.search(found, every, FEWER_STEPS))
        now = rest.search(by_present, SENSORS, FEWER_STEPS)
        more = tested.likelihood(then) - tested.likelihood(now)
        gains.append((float(more.sum()), float(tested.size.sum())))
    found = windows.at_least(found)
    if not seen.places:
        found[[Source.DISTANCE, Source.SLIP]] = present[[Source.DISTANCE, Source.SLIP]]
    sums = np.array(gains)
    gain, chance = with_chance(
        lambda left: float(np.divide(*sums[left].sum(axis=0))), np.ones(len(sums), dtype=bool)
    )
    turning = sum(one.turned for one in motions) / max(0.1, sum(one.metres for one in motions))
    return Noise(found, present, gain, chance, seen.places, turning, motions[0].track)


class _Motion(Struct, frozen=True):
    """The motion of a window by the wheels, in short steps."""

    middle: Floats
    """Times in the middle of the steps, s."""
    distance: Floats
    """Distance of each step, m."""
    turn: Floats
    track: float

    @property
    def metres(self) -> float:
        """Distance ahead and back, m."""
        return float(np.abs(self.distance).sum())

    @property
    def turned(self) -> float:
        """Sum of the turns to both sides, rad."""
        return float(np.abs(self.turn).sum())

    @classmethod
    def of(cls, t: Floats, way: Path, track: float) -> _Motion:
        """Return the motion between these times."""
        count = max(1, round((t[-1] - t[0]) / FINE_S))
        edges = np.linspace(t[0], t[-1], count + 1)
        heading, place = np.interp(edges, way.t, way.heading), np.interp(edges, way.t, way.place)
        turn = np.diff(heading)
        ahead = np.exp(-1j * (heading[:-1] + turn / 2))
        return cls((edges[1:] + edges[:-1]) / 2, np.real(np.diff(place) * ahead), turn, track)


class _Window(Struct, frozen=True):
    """The residuals of a window, and the effect of each step's errors on them."""

    residual: Floats
    start: Floats
    """Effects of the unknown start, shape (residuals, unknowns)."""
    motion: _Motion
    along: Floats
    """Effect of an error of each step's distance, shape (residuals, steps)."""
    yaw: Floats
    """Effect of an error of each step's turn, shape (residuals, steps)."""
    sensor: dict[Source, Floats]
    """The matrices C_i of the sensor's errors."""
    bias: Floats | float = 0.0
    """Covariance of the residuals by the uncertainty of the gyro's bias."""

    def projected(self, known: Deviations) -> tuple[Floats, Floats, Floats]:
        """Return the residuals, C_i and K without the unknown start."""
        distance, turn, track = self.motion.distance, self.motion.turn, self.motion.track
        sides = np.maximum(np.abs(distance), track / 2 * np.abs(turn))
        effects = np.zeros((COUNT, len(self.residual), len(self.residual)))
        effects[Source.DISTANCE] = (self.along * np.abs(distance)) @ self.along.T
        effects[Source.YAW] = (self.yaw * sides) @ self.yaw.T
        effects[Source.SKID] = (self.yaw * np.abs(turn)) @ self.yaw.T
        for source, lasting in (
            (Source.SLIP, self.along @ distance), (Source.TRACK, self.yaw @ turn),
            (Source.RATIO, self.yaw @ distance / track),
        ):  # fmt: skip
            effects[source] = np.outer(lasting, lasting)
        for source, matrix in self.sensor.items():
            effects[source] = matrix
        sure_of = (
            known.scale**2 * effects[Source.SLIP] + known.ratio**2 * effects[Source.RATIO]
            + known.track**2 * effects[Source.TRACK] + self.bias
        )  # fmt: skip
        kept = np.linalg.qr(self.start, mode="complete")[0][:, self.start.shape[1] :]
        return kept.T @ self.residual, kept.T @ effects @ kept, kept.T @ sure_of @ kept


def _windows(
    held: Sequence[Fold], seen: Reference, known: Deviations, motions: list[_Motion]
) -> Windows | None:
    """Return the windows of all drives, and add their motions to `motions`."""
    rows = []
    for number, fold in enumerate(held):
        for window in _of_drive(fold, seen):
            motions.append(window.motion)
            rows.append((number, *window.projected(known)))
    rows = rows[:: 1 + len(rows) // MOST_WINDOWS]
    if not rows:
        return None
    most = max(len(residual) for _, residual, _, _ in rows)
    metres, turned = np.mean([(one.metres, one.turned) for one in motions], axis=0)
    lasting = np.array([metres, metres / motions[0].track ** 2, turned])
    made = Windows(
        np.array([number for number, *_ in rows]),
        np.array([float(len(residual)) for _, residual, *_ in rows]),
        np.zeros((len(rows), most)), np.zeros((len(rows), COUNT, most, most)),
        np.tile(np.eye(most), (len(rows), 1, 1)), lasting,
    )  # fmt: skip
    for at, (_, residual, effects, sure_of) in enumerate(rows):
        size = len(residual)
        made.residual[at, :size] = residual
        made.effects[at, :, :size, :size] = effects
        made.known[at, :size, :size] = sure_of + ROUNDING * np.eye(size)
    return made


def _of_drive(fold: Fold, seen: Reference) -> Iterator[_Window]:
    drive, parameters = fold.drive, fold.parameters.copy()
    parameters[P.DELAY :] = seen.parameters[P.DELAY :]
    run, way = seen.runs[drive.run], path(seen.steps[drive.run], seen.base, parameters)
    track = seen.base.separation / abs(float(parameters[P.INVERSE_TRACK]))
    if seen.headings is not None:
        heading, late = seen.headings.of[drive.run], seen.headings.delay
        ends = heading.t[[0, -1]] - late if len(heading.t) else np.zeros(2)
        for t in _times(max(drive.begin, ends[0]), min(drive.end, ends[1])):
            at = t + late
            whole = inside(at[:1], at[-1:], heading.gaps) & inside(t[:1], t[-1:], run.gaps)
            if whole[0]:
                yield _by_headings(t, at, heading, way, track, seen.headings, parameters)
    if seen.places:
        for segment in positions_of(drive, seen.runs):
            for t in _times(float(segment.t[0]), float(segment.t[-1])):
                part = slice(*np.searchsorted(segment.t, (t[0], t[-1])))
                yield from _by_places(
                    t, segment.t[part], segment.place[part], way, track, parameters
                )


def _times(begin: float, end: float) -> Iterator[Floats]:
    """Yield the times of the residuals of each window. Neighbouring windows overlap by half."""
    whole = min(end - begin, WINDOW_S)
    if whole > 0.0:
        count = max(1, round(2 * (end - begin) / WINDOW_S) - 1)
        for first in np.linspace(begin, end - whole, count):
            yield np.linspace(first, first + whole, max(LEAST, round(whole / APART_S)) + 1)


def _by_headings(
    t: Floats, at: Floats, heading: Heading, way: Path, track: float, headings: Headings,
    parameters: Floats,
) -> _Window:  # fmt: skip
    """Return the window of these times, at which the heading was measured at `at`."""
    motion, since = _Motion.of(t, way, track), t - t[0]
    turned = np.interp(at, heading.t, heading.angle) - parameters[P.BIAS_ERROR] * since
    residual = turned / (1 + parameters[P.SCALE_ERROR]) - np.interp(t, way.t, way.heading)
    yaw = (motion.middle < t[:, None]).astype(np.float64)
    sensor = {Source.HEADING: np.eye(len(t))}
    if headings.source == "yaw_rate":
        sensor[Source.DRIFT] = np.minimum(since[:, None], since)
    return _Window(
        residual, np.ones((len(t), 1)), motion, np.zeros_like(yaw), yaw, sensor,
        headings.bias_std**2 * np.outer(since, since),
    )  # fmt: skip


def _by_places(
    t: Floats, at: Floats, place: Complexes, way: Path, track: float, parameters: Floats
) -> Iterator[_Window]:
    """Yield the window of these positions, whose residuals are medians around the times `t`."""
    group = np.searchsorted((t[1:] + t[:-1]) / 2, at)
    numbers = range(len(t))
    if np.bincount(group, minlength=len(t)).min() == 0:
        return
    along = way.at(at, parameters)[0]
    centred, centred_path = place - place.mean(), along - along.mean()
    match = complex(np.vdot(centred_path, centred))
    off = centred * np.conj(match / abs(match) if match else 1.0) - centred_path
    residual = np.array(
        [complex(np.median(o.real), np.median(o.imag)) for o in (off[group == n] for n in numbers)]
    )
    spots = np.array([along[group == number].mean() for number in numbers])
    times = np.array([at[group == number].mean() for number in numbers]) - parameters[P.DELAY]
    motion = _Motion.of(t, way, track)
    before = motion.middle < times[:, None]
    ahead = np.exp(1j * np.interp(motion.middle, way.t, way.heading))
    lever = spots[:, None] - np.interp(motion.middle, way.t, way.place)
    unknown = np.column_stack((np.ones(len(t)), np.full(len(t), 1j), 1j * (spots - spots.mean())))
    yield _Window(
        _both(residual), _both(unknown), motion, _both(before * ahead), _both(before * 1j * lever),
        {Source.PLACE: np.eye(2 * len(t))},
    )  # fmt: skip


def _both(places: Complexes) -> Floats:
    """Return both coordinates of each place, first all of x."""
    return np.concatenate((places.real, places.imag))
