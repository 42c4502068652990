"""The geometry and the noise from the calibration of a log also describe other drives.

`-m "soak or not soak" -s` prints the table of `tests/README.md`. A row describes the robots of one
kind by these figures:

- the NEES with three degrees of freedom after drives of a minute, with the fitted noise and with
  the default noise,
- the squared errors of heading and distance after 10 s, divided by the variances that the odometry
  states,
- the error of the heading after 10 s, and the same error with the best track and radii, which a
  least-squares fit to the true motion finds,
- z: the error of the track, and the error of the ratio of the left to the right wheel radius,
  each divided by its standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import Struct, structs

from acsard.calibration import odometry_noise
from acsard.calibration.calibration_report import keys, parts, report
from acsard.calibration.fit import Parameter
from acsard.calibration.log_table import NoCalibrationError, Table
from acsard.calibration.multipliers import Deviations
from acsard.calibration.odometry_noise import (
    INITIAL_NOISE,
    SOURCE_COUNT,
    LogNoise,
    Source,
    Windows,
    settings,
)
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.calibration.positions import path, wheel_steps
from acsard.calibration.solve import Calibration, calibrate
from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.link.feedback import Feedback
from acsard.core.values import WheelSpeeds
from acsard.terminal.output import MAX_TEXT_WIDTH, plain
from tests.unit.calibration.cut import BASE, log_of_runs, table
from tests.unit.calibration.robots import (
    RADIUS,
    SEPARATION,
    Drive,
    Floats,
    Plan,
    Robot,
    drive,
    wander,
)  # fmt: skip
from tests.unit.core.motion.nees import AT, errors
from tests.unit.core.motion.odometer import Odometer

LINES = 5
"""Feedback lines that are joined to one for the odometry, to save time. Noise adds up."""

PIECE = 1000
"""Number of feedback lines after which heading and distance are judged: 10 s."""

ROBOTS, FEWER = 20, 8
"""Number of robots in a row of `tests/README.md`, and in any other row."""

GYRO_SCALE = 0.005

SKID = Robot(chi=1.5, rate=0.0, slip=0.02, outliers=0.0)
DIFFERENTIAL = Robot(chi=1.0, rate=0.0, slip=0.003, left=0.99, right=1.01, outliers=0.0)

LINKS = {"plain": (2, 3e-4), "checked": (2, 0.0), "counts": (9, 0.0)}
"""Decimals of the speeds and error of the sample times, s, by the kind of the link."""


def stalled(trip: Drive, *, gyro: bool, places: bool) -> Table:
    """Return the log of a computer that stalls for 50 to 250 ms, twelve times a minute.

    The computer stamps each sample when it reads it. It reads the samples of a stall when the stall
    ends.
    """
    rng = np.random.default_rng(len(trip.t))
    late = replace(trip, t=trip.t.copy(), gyro_t=trip.gyro_t.copy())
    for begin in np.arange(2.0, trip.t[-1] - 5.0, 5.0):
        end, lasts = begin + rng.uniform(1.0, 5.0), rng.uniform(0.05, 0.25)
        for times in (late.t, late.gyro_t):
            waiting = np.flatnonzero((times > end - lasts) & (times <= end))
            times[waiting] = end + 2e-4 * np.arange(len(waiting))
    return table(late, gyro=gyro, places=places)


def log_with_repeats(trip: Drive, *, gyro: bool, places: bool) -> Table:
    """Return a log in rows of 20 Hz, which repeat each position until the next one arrives."""
    assert places
    count = len(trip.t) // LINES * LINES
    t, left, right = (
        column[:count].reshape(-1, LINES).mean(axis=1) for column in (trip.t, trip.left, trip.right)
    )
    place = trip.place[np.maximum(0, np.searchsorted(trip.place_t, t, side="right") - 1)]
    rows = {"t": t, "left": left, "right": right, "x": place.real, "y": place.imag}
    turns = [{"t": trip.gyro_t, "yaw_rate": trip.gyro}] if gyro else []
    return Table.joined([rows, *turns])


class Set(Struct, frozen=True):
    """Robots of one kind, with the number and the length of the drives in the log of each robot."""

    robot: Robot
    drives: int = 1
    seconds: float = 90.0
    apart: float = 0.0
    """Standard deviation of each radius from drive to drive, as a fraction."""
    recorded: Callable[..., Table] = table
    """Makes the table of a drive."""

    def log(self, rng: np.random.Generator, scale: float = 1.0) -> list[Drive]:
        """Return random drives for a log. The gyro's values are multiplied by `scale`."""
        made = [self.drive(rng, wander(rng, self.seconds)) for _ in range(self.drives)]
        return [replace(trip, gyro=trip.gyro * scale) for trip in made]

    def calibration(self, log: Sequence[Drive], way: str) -> Calibration:
        gyro, places = WAYS[way]
        runs = log_of_runs(log, gyro=gyro, places=places, recorded=self.recorded)
        return calibrate(runs, DriveConfig())

    def drive(self, rng: np.random.Generator, plan: Plan) -> Drive:
        left, right = rng.normal(0.0, self.apart, 2) if self.apart else np.zeros(2)
        robot = self.robot
        robot = replace(robot, left=robot.left + left, right=robot.right + right, rng=rng)
        return drive(robot, plan)

    def track(self, log: Sequence[Drive]) -> float:
        """Return the true multiplier of the separation: the constant that fits the log best."""
        turns = np.abs(np.concatenate([np.diff(trip.yaw) for trip in log])) / 0.01
        return self.robot.chi * (1 + self.robot.rate * float(turns @ turns / turns.sum()))


SETS = {
    "skid, constant": Set(SKID),
    "skid, grows with the rate": Set(replace(SKID, rate=0.08)),
    "skid, three drives": Set(replace(SKID, rate=0.08), 3, 60.0),
    "skid, radii differ in each of 6 drives": Set(replace(SKID, slip=0.01), 6, 30.0, 0.004),
    "skid, 20 manoeuvres of 8 s": Set(replace(SKID, rate=0.08, slip=0.05), 20, 8.0),
    "differential": Set(DIFFERENTIAL),
    "differential, three drives": Set(DIFFERENTIAL, 3, 60.0),
    "skid, stalls": Set(SKID, recorded=stalled),
    "differential, stalls": Set(DIFFERENTIAL, recorded=stalled),
    "skid, gyro 0.3 s late": Set(replace(SKID, late=0.3)),
} | {
    f"{kind}, {counts} counts, {link}": Set(
        replace(robot, counts=counts, decimals=LINKS[link][0], period_noise=LINKS[link][1])
    )
    for kind, robot in (("skid", SKID), ("differential", DIFFERENTIAL))
    for counts in (16, 96, 3200)
    for link in LINKS
}  # fmt: skip

WAYS = {"gyro": (True, False), "positions": (False, True), "both": (True, True)}

ONE_WAY = {
    ("skid, held positions of 10 Hz", "positions"): Set(
        replace(SKID, place_hz=10.0), recorded=log_with_repeats
    ),
    ("skid, five minutes", "positions"): Set(SKID, seconds=300.0),
    ("differential, five minutes", "positions"): Set(DIFFERENTIAL, seconds=300.0),
    ("differential, five minutes", "both"): Set(DIFFERENTIAL, seconds=300.0),
}
"""Sets that are about some sensors only."""

ROWS = {(name, way): kind for name, kind in SETS.items() for way in WAYS} | ONE_WAY

SHOWN = [
    ("skid, constant", "gyro"), ("skid, constant", "positions"), ("skid, constant", "both"),
    ("skid, grows with the rate", "gyro"), ("skid, grows with the rate", "positions"),
    ("skid, radii differ in each of 6 drives", "both"),
    ("skid, 20 manoeuvres of 8 s", "gyro"), ("skid, 20 manoeuvres of 8 s", "positions"),
    ("skid, 16 counts, checked", "gyro"), ("skid, 16 counts, plain", "positions"),
    ("skid, 96 counts, counts", "gyro"), ("skid, 3200 counts, plain", "gyro"),
    ("skid, stalls", "gyro"), ("skid, gyro 0.3 s late", "gyro"), *ONE_WAY,
    ("differential", "gyro"), ("differential", "positions"), ("differential", "both"),
    ("differential, 16 counts, counts", "gyro"), ("differential, 96 counts, plain", "both"),
    ("differential, 3200 counts, checked", "both"), ("differential, stalls", "both"),
]  # fmt: skip
"""The rows of the table in `tests/README.md`."""

FINE = ("differential, 16 counts, counts", "gyro"), ("differential", "positions")
"""Rows whose best fit is so good that counts or positions hide the rest of the error."""

COARSE = "differential"
"""Begin of the kinds whose uncertainty may be stated twice too large.

In 90 s, positions with an error of 1 cm hide the small errors of these wheels: those of the
distance also beside a gyro.
"""

FURTHER = {"gyro": 1.12, "both": 1.5, "positions": 1.3}
"""Largest error of the heading by the sensors, as a multiple of that of the best fit.

A log of 90 s with a perfect sensor has 1.1. Positions with an error of 1 cm show less.
"""


def configs(calibration: Calibration) -> tuple[DriveConfig, OdometryConfig]:
    """Return the configuration that `--write` makes from the defaults and this calibration."""
    drive_config: dict[str, object] = {}
    noise: dict[str, object] = {}
    for key, value in keys(calibration).items():
        section, _, name = key.partition(".")
        (drive_config if section == "drive" else noise)[name] = value
    return (
        structs.replace(DriveConfig(), **drive_config), structs.replace(OdometryConfig(), **noise)
    )  # fmt: skip


def judged(
    trip: Drive, begin: int, end: int, robot: tuple[DriveConfig, OdometryConfig], counts: int
) -> tuple[float, float, float]:
    """Return the NEES of a part of a drive, and the normalized squares of two errors.

    These are the squared errors of heading and distance, divided by the variances that the odometry
    states.
    """
    odom = Odometer(robot[1], counts, robot[0])
    end = begin + (end - begin) // LINES * LINES
    sides = (side[begin:end].reshape(-1, LINES).mean(axis=1) for side in (trip.left, trip.right))
    for left, right in zip(*sides, strict=True):
        line = Feedback(AT, WheelSpeeds(right, left, left, right), 0.01 * LINES)
        estimate = odom.fold(line)
    start = 0j if begin == 0 else trip.where[begin - 1]
    yaw = 0.0 if begin == 0 else trip.yaw[begin - 1]
    moved = (trip.where[end - 1] - start) * np.exp(-1j * yaw)
    truth = np.array([[moved.real], [moved.imag], [trip.yaw[end - 1] - yaw]])
    pose, p = estimate.pose, estimate.covariance
    e = errors(np.array([pose.x, pose.y, pose.yaw]), truth)[:, 0]
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    of_odom = np.array([[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]])
    covariance = turned @ of_odom @ turned.T
    return (
        float(e @ np.linalg.solve(covariance, e)),
        float(e[2] ** 2 / covariance[2, 2]), float(e[0] ** 2 / covariance[0, 0]),
    )  # fmt: skip


class Row(Struct, frozen=True):
    """The figures of the robots of one kind."""

    nees: float
    heading: float
    """Mean square of the heading's error, in the variance that the odometry states."""
    distance: float
    default: float
    """NEES with the default noise."""
    error: float
    """Rms error of the heading after `PIECE` lines, deg."""
    best: float
    """The same error with the best track and radii."""
    track: float
    """Rms z of the track, NaN if it always stays as configured."""
    ratio: float
    """Rms z of the ratio of left to right, or NaN."""
    refused: int
    """Number of robots whose log is refused. They keep their configuration and do not count."""


def measured(kind: Set, way: str, robots: int) -> Row:
    refused = 0
    whole, default, tracks, ratios = (list[float]() for _ in range(4))
    pieces, turns = list[tuple[float, float]](), list[tuple[float, float, float]]()
    off: list[float] = []
    for seed in range(robots):
        rng = np.random.default_rng(9000 + seed)
        scale = 1.0 + rng.normal(0.0, GYRO_SCALE)
        log = kind.log(rng, scale)
        try:
            calibration = kind.calibration(log, way)
        except NoCalibrationError:
            refused += 1
            continue
        robot, made, counts = configs(calibration), calibration.multipliers, kind.robot.counts
        track, left, right = made.values
        if TRACK not in calibration.stays_configured:
            tracks.append((track - kind.track(log)) / made.std[0])
        if RATIO not in calibration.stays_configured:
            true = kind.robot.right / kind.robot.left
            ratios.append(math.log(right / left / true) / made.relative_deviations().ratio)
        # No other sensor shows the scale of this gyro: the best odometry turns as far as it says.
        gyro_scale = scale if way == "gyro" else 1.0
        for _ in range(2):
            trip = kind.drive(rng, wander(rng, 60.0))
            last = len(trip.t)
            whole.append(judged(trip, 0, last, robot, counts)[0])
            default.append(judged(trip, 0, last, (robot[0], OdometryConfig()), counts)[0])
            for at in range(200, last - PIECE + 1, PIECE):
                pieces.append(judged(trip, at, at + PIECE, robot, counts)[1:])
                rolled = (trip.left[at : at + PIECE].sum(), trip.right[at : at + PIECE].sum())
                a, b = (0.01 * RADIUS / SEPARATION * float(side) for side in rolled)
                turned = float(trip.yaw[at + PIECE - 1] - trip.yaw[at - 1])
                turns.append((a, b, turned))
                off.append((right * b - left * a) / track / gyro_scale - turned)
    sides, true_turns = np.array(turns)[:, :2], np.array(turns)[:, 2]
    least = true_turns - sides @ np.linalg.lstsq(sides, true_turns, rcond=None)[0]
    heading, distance = np.mean(pieces, axis=0).tolist()
    return Row(
        float(np.mean(whole)), heading, distance, float(np.mean(default)),
        math.degrees(rms(off)), math.degrees(rms(least)), rms(tracks), rms(ratios), refused,
    )  # fmt: skip


def rms(values: Floats | Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "way"), ROWS)
def test_the_noise_of_a_calibration_describes_drives_outside_of_its_log(
    name: str, way: str
) -> None:
    """With a gyro only the heading is compared, because a gyro shows no errors of distance."""
    in_table = (name, way) in SHOWN
    row = measured(ROWS[name, way], way, ROBOTS if in_table else FEWER)
    print(
        f"\n| {name}; {way} | {row.nees:.1f} | {row.heading:.1f} | {row.distance:.1f} | "
        f"{row.default:.2g} | {row.error:.2f} | {row.best:.2f} | {row.error / row.best - 1:.0%} | "
        f"{row.track:.2f} | {row.ratio:.2f} | {row.refused} |"
    )
    coarse = name.startswith(COARSE)
    assert (0.25 if coarse and way != "gyro" else 0.5) < row.heading < 2.0
    if way != "gyro":
        assert (1.0 if coarse else 1.5) < row.nees < 6.0
        assert (0.25 if coarse else 0.5) < row.distance < 2.0
    if in_table:
        fine = (name, way) in FINE
        assert row.error < (1.5 if fine else FURTHER[way]) * row.best
        assert 0.6 < row.track < 1.6
        assert 0.6 < row.ratio < 1.6
        assert not row.refused


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "way"), [("differential", "both"), ("skid, grows with the rate", "gyro")]
)
def test_the_noise_of_a_calibration_describes_other_drives_of_three_robots(
    name: str, way: str
) -> None:
    row = measured(SETS[name], way, 3)
    assert 0.5 < row.heading < 2.0
    assert way == "gyro" or 0.4 < row.distance < 2.0
    assert row.error < 1.3 * row.best


LOG = SETS["differential"].log(np.random.default_rng(1), 1.003)


@pytest.fixture(scope="module")
def found() -> Calibration:
    return SETS["differential"].calibration(LOG, "both")


@pytest.mark.slow
def test_noise_is_written_beside_the_geometry_and_reported(found: Calibration) -> None:
    before, after = OdometryConfig(), configs(found)[1]
    assert after.yaw_variance_per_metre < before.yaw_variance_per_metre
    assert after.yaw_variance_per_radian < before.yaw_variance_per_radian / 10
    assert after.distance_variance_per_metre < before.distance_variance_per_metre
    made = report("a.csv", found, DriveConfig(), "")
    text = plain(*parts(made, found, "f", guided=False), width=MAX_TEXT_WIDTH)
    assert (
        "random heading error after 10 m of driving, according to the odometry messages: " in text
    )
    assert "random distance error after 10 m of driving, according to the odometry" in text


@pytest.mark.slow
def test_noise_that_is_already_right_stays_as_configured(found: Calibration) -> None:
    """The configuration has the right noise and a wrong geometry.

    The calibration changes only the geometry.
    """
    log = log_of_runs(LOG)
    again = calibrate(log, DriveConfig(), None, configs(found)[1])
    assert again.noise is not None
    assert not again.noise.better
    assert not any("variance" in name or "slip" in name for name in again.odometry)
    assert any("stay as configured" in note for note in again.notes)


@pytest.mark.slow
def test_noise_of_a_robot_whose_geometry_is_right_is_written_alone(found: Calibration) -> None:
    geometry = configs(found)[0]
    present = OdometryConfig()
    log = log_of_runs(LOG)
    again = calibrate(log, geometry, None, present)
    assert set(again.stays_configured) == {TRACK, RATIO}
    assert configs(again)[0] == geometry
    written = structs.replace(present, **again.odometry)
    assert written.yaw_variance_per_radian < present.yaw_variance_per_radian / 10


def test_positions_that_are_recorded_a_second_later_give_the_same_window() -> None:
    trip = LOG[0]
    run = log_of_runs([trip], gyro=False).runs[0]
    early = BASE.start()
    steps = wheel_steps(run)
    times = np.linspace(2.0, 20.0, 6)
    within = (run.place_t >= 2.0) & (run.place_t <= 20.0)
    late = early.copy()
    late[Parameter.DELAY] = 1.0
    first, other = (
        next(
            odometry_noise._by_places(
                times + p[Parameter.DELAY], run.place_t[within] + p[Parameter.DELAY],
                run.place[within], path(steps, BASE, p), 0.3,
            )
        )
        for p in (early, late)
    )  # fmt: skip
    assert other.residual == pytest.approx(first.residual)
    assert other.motion.distance == pytest.approx(first.motion.distance)
    assert other.motion.turn == pytest.approx(first.motion.turn)
    assert other.yaw == pytest.approx(first.yaw)
    assert other.along == pytest.approx(first.along)


def test_a_log_with_only_a_gyro_gives_no_distance_noise() -> None:
    made = SETS["differential"].calibration(LOG, "gyro")
    assert "yaw_variance_per_metre" in made.odometry
    assert "distance_variance_per_metre" not in made.odometry


@pytest.mark.parametrize(("size", "written"), [(0.9e-5, 0.0), (1.1e-5, 1.1e-5)])
def test_a_negligible_deviation_is_written_as_zero_and_a_small_variance_is_kept(
    size: float, written: float
) -> None:
    found = np.full(SOURCE_COUNT, size**2)
    made = settings(
        Deviations(size, size, size), 1.0, (),
        LogNoise(found, INITIAL_NOISE, 1.0, 0.1, True, 1.0), scaled=True,
    )  # fmt: skip
    variances = {name: made.pop(name) for name in list(made) if "variance" in name}
    assert variances == dict.fromkeys(
        ("yaw_variance_per_metre", "yaw_variance_per_radian", "distance_variance_per_metre"),
        size**2,
    )
    assert made == pytest.approx(
        dict.fromkeys(
            ("wheel_separation_multiplier_std", "wheel_radius_ratio_std", "distance_scale_std"),
            written,
        ), rel=1e-9, abs=0.0,
    )  # fmt: skip


def test_the_search_finds_the_noise_that_made_the_residuals() -> None:
    """The residuals contain noise per radian, and noise of the sensor."""
    rng, size, count = np.random.default_rng(3), 8, 600
    effects = np.zeros((count, SOURCE_COUNT, size, size))
    sums = np.minimum.outer(np.arange(1.0, size + 1), np.arange(1.0, size + 1))
    true = np.zeros(SOURCE_COUNT)
    for source, matrix, amount in (
        (Source.SKID, sums, 2e-3), (Source.HEADING, np.eye(size), 3e-3),
    ):  # fmt: skip
        effects[:, source], true[source] = matrix, amount
    windows = Windows(
        np.zeros(count, dtype=np.int64), np.full(count, float(size)),
        rng.multivariate_normal(np.zeros(size), np.tensordot(true, effects[0], 1), count),
        effects, np.zeros((count, size, size)),
    )  # fmt: skip
    noise = windows.search(INITIAL_NOISE, np.ones(SOURCE_COUNT, dtype=bool))
    used = true > 0.0
    assert noise[used] == pytest.approx(true[used], rel=0.2)
    assert windows.at_least(noise)[used] == pytest.approx(noise[used], rel=0.05)


@pytest.mark.parametrize(("count", "used"), [(79, 79), (80, 80), (81, 41), (159, 80), (160, 80)])
def test_the_noise_is_computed_from_at_most_80_evenly_spaced_windows(count: int, used: int) -> None:
    effects = np.zeros((SOURCE_COUNT, 1, 1))
    single: list[Any] = [
        SimpleNamespace(
            projected=lambda _, n=number: (np.array([float(n)]), effects, np.zeros((1, 1))),
        )
        for number in range(count)
    ]
    known: Any = None
    windows = odometry_noise._padded([(0, window) for window in single], known)
    assert len(windows.residual) == used
    assert np.ptp(np.diff(windows.residual[:, 0])) == 0.0
