"""Fits the noise settings of `[odometry]` to drives that the fit of the geometry did not use.

A drive is divided into windows of half a minute. A residual is a measured heading or position minus
that of the wheels. `Windows.search` maximizes the likelihood of all residuals. Those of a window
are seconds apart, because some errors last for a whole turn.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.fit import Base, Parameter, student_factor
from acsard.calibration.heading import Heading, Headings
from acsard.calibration.improvement import SURE_DEVIATIONS, Fold, positions_of, with_gain_std
from acsard.calibration.log_table import Floats
from acsard.calibration.multipliers import Deviations
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.calibration.positions import WheelPath, WheelSteps, path
from acsard.calibration.runs import Complexes, Mask, Run, inside
from acsard.core.config.settings import OdometryConfig
from acsard.core.values import Metres


class Source(IntEnum):
    """Sources of random errors, by their variances; the last three are those of the sensors."""

    DISTANCE = 0  # of the distance, per metre driven, m2/m
    YAW = 1  # of the heading, per metre that the wheels roll (mean of both sides), rad2/m
    SKID = 2  # of the heading, per radian that the robot turns, rad2/rad
    HEADING = 3  # of a measured heading, rad2
    DRIFT = 4  # growth for the gyro's heading per second, rad2/s
    PLACE = 5  # of a measured coordinate, m2


SOURCE_COUNT = len(Source)
SENSOR_SOURCES = np.arange(SOURCE_COUNT) >= Source.HEADING
INITIAL_NOISE = np.array([1e-4, 1e-4, 1e-3, 1e-5, 1e-6, 1e-4])  # they only have to be positive

# Length of a window, or of a shorter drive, and time between the residuals in it.
WINDOW_S, APART_S = 32.0, 4.0

MIN_INTERVALS = 4  # between the residuals of a window

MAX_WINDOWS = 80  # of more, only every n-th is used

STEP_S = 0.5  # errors are independent from step to step

MAX_FOLDS = 10  # groups of drives that are left out in turn, which takes two searches each

# Fewer suffice for a search that starts from the noise of the whole log.
STEPS, FEWER_STEPS = 150, 60

OUTLIER_LIMIT = 9.0  # mean square of normalized residuals, above which a window weighs less

MIN_VARIANCE = 1e-12  # of each residual, so that a perfect sensor's covariance can be inverted

# The fit of a short log often finds 0, and the odometry would state that the pose is exact.
MIN_NOISE_RATIO = 0.25

# Mean loss of log likelihood per residual if each deviation is stated at twice its true value. A
# larger gain is better even if its deviation is large.
CERTAIN_GAIN = math.log(2.0) - 3 / 8

MAX_SETTING = 1.0  # that the configuration accepts

# Each deviation above 0 costs the daemon a column of the covariance in each period. This is the
# rounding of the multipliers; a perfect simulated robot gave 1e-5 to 1e-25.
MIN_STD = 1e-5

REPORT_DISTANCE_M = 10.0  # for which the report states the errors of heading and distance


# The residuals of a window are modelled as normal with mean 0. Their covariance V is linear in the
# noise x, which contains one number x_i for each `Source`. C_i is the covariance that noise of
# x_i = 1 causes (`effects`). K is the covariance that the known uncertainty of the geometry causes
# (`known`):
#
#     V = K + sum over i of x_i C_i
#
# The pose at the start of the window is unknown and is projected out (restricted maximum
# likelihood: Patterson & Thompson, Biometrika 58, 1971). The iteration of Zhou, Hu, Qiao, Cho &
# Zhou (MM Algorithms for Variance Components Models, 2019) finds x. Its sums run over the windows,
# and no x_i becomes negative:
#
#     x_i <- x_i sqrt(sum of r' V^-1 C_i V^-1 r / sum of tr(V^-1 C_i))
class Windows(Struct, frozen=True):
    """The windows of a log (half a minute each), padded to the same number n of residuals."""

    drive: npt.NDArray[np.int64]  # index of the drive of each window
    size: Floats  # number of residuals of each window, without the padding
    residual: Floats  # without the unknown start pose, shape (windows, n)
    effects: Floats  # covariance by a noise of 1, shape (windows, SOURCE_COUNT, n, n)
    known: Floats  # covariance by the uncertain geometry and gyro bias, shape (windows, n, n)

    def of(self, chosen: Mask | npt.NDArray[np.int64]) -> Windows:
        return Windows(
            self.drive[chosen], self.size[chosen], self.residual[chosen], self.effects[chosen],
            self.known[chosen],
        )  # fmt: skip

    def covariance(self, noise: Floats) -> Floats:
        """Return the covariance of the residuals, shape (windows, n, n)."""
        return np.asarray(np.tensordot(self.effects, noise, (1, 0)) + self.known)

    def search(self, start: Floats, free: Mask, steps: int = STEPS) -> Floats:
        """Return the noise of the greatest likelihood; sources outside the mask `free` stay."""
        noise, flat = start.copy(), np.moveaxis(self.effects, 1, 0).reshape(SOURCE_COUNT, -1)
        for _ in range(steps):
            inverse = np.linalg.inv(self.covariance(noise))
            scores = np.einsum("wij,wj->wi", inverse, self.residual)
            squares = np.einsum("wi,wi->w", scores, self.residual)
            weight = np.minimum(1.0, OUTLIER_LIMIT * self.size / np.maximum(squares, 1e-300))
            actual = flat @ np.einsum("w,wi,wj->wij", weight, scores, scores).ravel()
            expected = flat @ inverse.ravel()
            used = free & (expected > 0.0)
            noise[used] *= np.sqrt(actual[used] / expected[used])
        return noise

    def at_least(self, noise: Floats) -> Floats:
        """Return `noise`, increased where few residuals may make it too small."""
        # Windows overlap by half, so each residual counts as half a degree of freedom.
        shares = np.linalg.inv(self.covariance(noise))[:, None] @ self.effects
        free = noise * np.einsum("wkii->k", shares) / 2
        noise = np.where(SENSOR_SOURCES, noise, noise * student_factor(free))
        information = np.einsum("wkij,wkji->k", shares, shares) / 2
        least = np.where(
            information > 0.0, MIN_NOISE_RATIO / np.sqrt(np.maximum(information, 1e-300)), 0.0
        )
        least[SENSOR_SOURCES] = 0.0
        return np.asarray(np.maximum(noise, least))

    def likelihood(self, noise: Floats) -> Floats:
        """Return the log likelihood of the residuals of each window, up to a constant."""
        covariance = self.covariance(noise)
        solved = np.linalg.solve(covariance, self.residual[:, :, None])[:, :, 0]
        squares = np.einsum("wi,wi->w", solved, self.residual)
        squares = np.minimum(squares, OUTLIER_LIMIT * self.size)
        return np.asarray(-(np.linalg.slogdet(covariance)[1] + squares) / 2)


class LogNoise(Struct, frozen=True):
    """The noise of the odometry in a log, compared with the configured noise."""

    found: Floats  # the noise that the log shows, a number for each `Source`
    present: Floats  # the configured noise of the robot, a number for each `Source`
    log_likelihood_gain: float  # per residual, of the found noise over the configured one
    gain_std: float  # of `log_likelihood_gain`, from the differences between drives
    places: bool  # the log has positions, which alone show the noise of the distance
    turning: float  # total turned angle per metre driven in this log, rad/m

    @property
    def better(self) -> bool:
        """Whether the found noise describes other drives clearly better than the configured one."""
        return self.log_likelihood_gain > min(SURE_DEVIATIONS * self.gain_std, CERTAIN_GAIN)

    def heading(self) -> tuple[float, float]:
        """Return the deviation of the heading after `REPORT_DISTANCE_M`, rad: configured, found."""
        now, then = (
            math.sqrt(REPORT_DISTANCE_M * (x[Source.YAW] + self.turning * x[Source.SKID]))
            for x in (self.present, self.found)
        )
        return now, then

    def distance(self) -> tuple[float, float]:
        """Return the deviation of the distance after `REPORT_DISTANCE_M`, m: configured, found."""
        now, then = (
            math.sqrt(REPORT_DISTANCE_M * x[Source.DISTANCE]) for x in (self.present, self.found)
        )
        return now, then


def settings(
    known: Deviations, track: float, fixed: Collection[str], log_noise: LogNoise | None = None,
    *, scaled: bool,
) -> dict[str, float]:  # fmt: skip
    """Return the new values for settings of `[odometry]`, by the name of the setting.

    `fixed` names the quantities that stay as configured: `plausibility.TRACK` and `RATIO`. `scaled`
    says whether the size of the wheels was measured.
    """
    values: dict[str, float] = {}
    if TRACK not in fixed:
        values["wheel_separation_multiplier_std"] = track * known.track
    if RATIO not in fixed:
        values["wheel_radius_ratio_std"] = known.ratio
    if scaled:
        values["distance_scale_std"] = known.scale
    if log_noise is not None:
        values["yaw_variance_per_metre"] = float(log_noise.found[Source.YAW])
        values["yaw_variance_per_radian"] = float(log_noise.found[Source.SKID])
        if log_noise.places:
            values["distance_variance_per_metre"] = float(log_noise.found[Source.DISTANCE])
    return {
        name: 0.0 if name.endswith("_std") and value < MIN_STD else min(value, MAX_SETTING)
        for name, value in values.items()
    }


class Reference(Struct, frozen=True):
    """The sensors of a log, and the parameters that were fitted to the whole log."""

    runs: Sequence[Run]
    headings: Headings | None  # None if the log has no heading sensor
    places: bool  # the log has positions
    steps: Sequence[WheelSteps]
    base: Base
    # Fitted to the whole log; those from `Parameter.DELAY` on describe the sensors.
    parameters: Floats


def noise(
    folds: Sequence[Fold], sensors: Reference, known: Deviations, odometry: OdometryConfig
) -> LogNoise | None:
    """Return the noise that a log shows, or None if fewer than two drives have residuals."""
    numbered = [
        (at, window) for at, fold in enumerate(folds) for window in _of_drive(fold, sensors)
    ]
    windows = _padded(numbered, known) if numbered else None
    if windows is None or len(np.unique(windows.drive)) < 2:
        return None
    motions = [window.motion for _, window in numbered]
    present = INITIAL_NOISE.copy()
    present[: Source.HEADING] = (
        odometry.distance_variance_per_metre, odometry.yaw_variance_per_metre,
        odometry.yaw_variance_per_radian,
    )  # fmt: skip
    every = np.ones(SOURCE_COUNT, dtype=bool)
    estimate = windows.search(INITIAL_NOISE, every)
    by_present = windows.search(present, SENSOR_SOURCES)
    gains: list[tuple[float, float]] = []
    fold = np.unique(windows.drive, return_inverse=True)[1] % MAX_FOLDS
    for number in range(fold.max() + 1):
        out = fold == number
        rest, tested = windows.of(~out), windows.of(out)
        then = rest.at_least(rest.search(estimate, every, FEWER_STEPS))
        now = rest.search(by_present, SENSOR_SOURCES, FEWER_STEPS)
        more = tested.likelihood(then) - tested.likelihood(now)
        gains.append((float(more.sum()), float(tested.size.sum())))
    estimate = windows.at_least(estimate)
    if not sensors.places:
        estimate[Source.DISTANCE] = present[Source.DISTANCE]
    sums = np.array(gains)
    gain, gain_std = with_gain_std(
        lambda left: float(np.divide(*sums[left].sum(axis=0))), np.ones(len(sums), dtype=bool)
    )
    turning = sum(move.turned for move in motions) / max(0.1, sum(move.metres for move in motions))
    return LogNoise(estimate, present, gain, gain_std, sensors.places, turning)


class _Motion(Struct, frozen=True):
    middle: Floats  # times in the middle of the steps, s
    distance: Floats  # of each step, m
    turn: Floats  # of each step, rad
    track: Metres  # effective

    @property
    def metres(self) -> float:
        return float(np.abs(self.distance).sum())

    @property
    def turned(self) -> float:
        return float(np.abs(self.turn).sum())

    @classmethod
    def of(cls, t: Floats, way: WheelPath, track: float) -> _Motion:
        count = max(1, round((t[-1] - t[0]) / STEP_S))
        edges = np.linspace(t[0], t[-1], count + 1)
        heading, place = np.interp(edges, way.t, way.heading), np.interp(edges, way.t, way.place)
        turn = np.diff(heading)
        ahead = np.exp(-1j * (heading[:-1] + turn / 2))
        return cls((edges[1:] + edges[:-1]) / 2, np.real(np.diff(place) * ahead), turn, track)


class _Window(Struct, frozen=True):
    residual: Floats
    start: Floats  # derivatives by the start pose, shape (residuals, unknowns)
    motion: _Motion
    # Change of each residual by an error in a step's distance, m, or turn, rad, shape (residuals,
    # steps).
    along: Floats
    yaw: Floats
    sensor: dict[Source, Floats]  # covariance by a sensor noise of 1
    bias: Floats | float = 0.0  # covariance by the uncertain bias of the gyro; 0 without one

    def projected(self, known: Deviations) -> tuple[Floats, Floats, Floats]:
        """Return the residuals and their covariances after projecting out the unknown start pose.

        The covariances are those of each `Source` with a noise of 1, and that of the uncertain
        geometry (`known`) and gyro bias.
        """
        distance, turn, track = self.motion.distance, self.motion.turn, self.motion.track
        sides = np.maximum(np.abs(distance), track / 2 * np.abs(turn))
        effects = np.zeros((SOURCE_COUNT, len(self.residual), len(self.residual)))
        effects[Source.DISTANCE] = (self.along * np.abs(distance)) @ self.along.T
        effects[Source.YAW] = (self.yaw * sides) @ self.yaw.T
        effects[Source.SKID] = (self.yaw * np.abs(turn)) @ self.yaw.T
        for source, matrix in self.sensor.items():
            effects[source] = matrix
        sure_of = self.bias
        for std, lasting in (
            (known.scale, self.along @ distance), (known.ratio, self.yaw @ distance / track),
            (known.track, self.yaw @ turn),
        ):  # fmt: skip
            sure_of = sure_of + std**2 * np.outer(lasting, lasting)
        basis = np.linalg.qr(self.start, mode="complete")[0][:, self.start.shape[1] :]
        return basis.T @ self.residual, basis.T @ effects @ basis, basis.T @ sure_of @ basis


def _padded(numbered: Sequence[tuple[int, _Window]], known: Deviations) -> Windows:
    used = numbered[:: math.ceil(len(numbered) / MAX_WINDOWS)]
    rows = [(drive, *window.projected(known)) for drive, window in used]
    most = max(len(residual) for _, residual, _, _ in rows)
    made = Windows(
        np.array([drive for drive, *_ in rows]),
        np.array([float(len(residual)) for _, residual, *_ in rows]),
        np.zeros((len(rows), most)), np.zeros((len(rows), SOURCE_COUNT, most, most)),
        np.tile(np.eye(most), (len(rows), 1, 1)),
    )  # fmt: skip
    for at, (_, residual, effects, sure_of) in enumerate(rows):
        size = len(residual)
        made.residual[at, :size] = residual
        made.effects[at, :, :size, :size] = effects
        made.known[at, :size, :size] = sure_of + MIN_VARIANCE * np.eye(size)
    return made


def _of_drive(fold: Fold, sensors: Reference) -> Iterator[_Window]:
    drive, parameters = fold.drive, fold.parameters.copy()
    parameters[Parameter.DELAY :] = sensors.parameters[Parameter.DELAY :]
    run, way = sensors.runs[drive.run], path(sensors.steps[drive.run], sensors.base, parameters)
    track = sensors.base.separation / abs(float(parameters[Parameter.INVERSE_TRACK]))
    if sensors.headings is not None:
        heading, late = sensors.headings.per_run[drive.run], sensors.headings.delay
        ends = heading.t[[0, -1]] - late if len(heading.t) else np.zeros(2)
        for t in _times(max(drive.begin, ends[0]), min(drive.end, ends[1])):
            at = t + late
            whole = inside(at[:1], at[-1:], heading.gaps) & inside(t[:1], t[-1:], run.gaps)
            if whole[0]:
                yield _by_headings(t, at, heading, way, track, sensors.headings)
    if sensors.places:
        for segment in positions_of(drive, sensors.runs):
            for t in _times(float(segment.t[0]), float(segment.t[-1])):
                part = slice(*np.searchsorted(segment.t, (t[0], t[-1])))
                yield from _by_places(t, segment.t[part], segment.place[part], way, track)


def _times(begin: float, end: float) -> Iterator[Floats]:
    whole = min(end - begin, WINDOW_S)
    if whole > 0.0:
        count = max(1, round(2 * (end - begin) / WINDOW_S) - 1)
        for first in np.linspace(begin, end - whole, count):
            yield np.linspace(first, first + whole, max(MIN_INTERVALS, round(whole / APART_S)) + 1)


def _by_headings(
    t: Floats, at: Floats, heading: Heading, way: WheelPath, track: float, headings: Headings
) -> _Window:
    motion, since, parameters = _Motion.of(t, way, track), t - t[0], way.parameters
    turned = np.interp(at, heading.t, heading.angle) - parameters[Parameter.BIAS_ERROR] * since
    residual = turned / (1 + parameters[Parameter.SCALE_ERROR]) - np.interp(t, way.t, way.heading)
    yaw = (motion.middle < t[:, None]).astype(np.float64)
    sensor = {Source.HEADING: np.eye(len(t))}
    if headings.source == "yaw_rate":
        sensor[Source.DRIFT] = np.minimum(since[:, None], since)
    return _Window(
        residual, np.ones((len(t), 1)), motion, np.zeros_like(yaw), yaw, sensor,
        headings.bias_std**2 * np.outer(since, since),
    )  # fmt: skip


def _by_places(
    t: Floats, at: Floats, place: Complexes, way: WheelPath, track: float
) -> Iterator[_Window]:
    group, delay_s = np.searchsorted((t[1:] + t[:-1]) / 2, at), way.parameters[Parameter.DELAY]
    numbers = range(len(t))
    if np.bincount(group, minlength=len(t)).min() == 0:
        return
    along = way.at(at)[0]
    centred, centred_path = place - place.mean(), along - along.mean()
    match = complex(np.vdot(centred_path, centred))
    off = centred * np.conj(match / abs(match) if match else 1.0) - centred_path
    residual = np.array(
        [complex(np.median(o.real), np.median(o.imag)) for o in (off[group == n] for n in numbers)]
    )
    spots = np.array([along[group == number].mean() for number in numbers])
    times = np.array([at[group == number].mean() for number in numbers]) - delay_s
    motion = _Motion.of(t - delay_s, way, track)
    before = motion.middle < times[:, None]
    ahead = np.exp(1j * np.interp(motion.middle, way.t, way.heading))
    lever = spots[:, None] - np.interp(motion.middle, way.t, way.place)
    unknown = np.column_stack((np.ones(len(t)), np.full(len(t), 1j), 1j * (spots - spots.mean())))
    yield _Window(
        _both(residual), _both(unknown), motion, _both(before * ahead), _both(before * 1j * lever),
        {Source.PLACE: np.eye(2 * len(t))},
    )  # fmt: skip


def _both(places: Complexes) -> Floats:
    return np.concatenate((places.real, places.imag))
