"""The geometry and the noise from the calibration of a log also describe other drives.

`-n 0 -s -m soak` prints the figures of the manual's page about calibration: the NEES after drives
of a minute, with the fitted and with the default noise; the squared errors of heading and distance
after 10 s in the variances that the odometry states; the error of the heading after 10 s, and that
of the best track and radii; and the errors of track and radii in their standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from msgspec import Struct, structs

from acsard.calibration import noise as noises
from acsard.calibration.fit import AHEAD, ASIDE, Piece, fit
from acsard.calibration.geometry import LEFT, RIGHT, TRACK, Base
from acsard.calibration.log import Log, Run
from acsard.calibration.noise import (
    SQUARE,
    Path,
    _bend,
    _distance,
    _fitted,
    _heading,
    _likelihood,
    _Rows,
    _solved,
    noise,
)
from acsard.calibration.result import calibrate
from acsard.calibration.series import Complexes
from acsard.core.config.settings import Config, DriveConfig, OdometryConfig
from acsard.core.link.feedback import Line
from acsard.core.values import WheelSpeeds
from tests.unit.calibration_bags import motion
from tests.unit.calibration_logs import WAYS, by_headings, runs
from tests.unit.calibration_robots import (
    RADIUS,
    SEPARATION,
    Drive,
    Floats,
    Plan,
    Robot,
    drive,
    wander,
)  # fmt: skip
from tests.unit.nees import AT, errors
from tests.unit.odometer import Odometer
from tests.unit.test_calibration_matches import LEGS
from tests.unit.test_calibration_matches import log as sensed

LINES = 5
"""Feedback lines that are joined to one for the odometry, to save time. Noise adds up."""

PIECE = 1000
"""Number of feedback lines after which heading and distance are judged: 10 s."""

ROBOTS = 6
"""Number of robots in a row."""

GYRO_SCALE = 0.005
CONFIG = Config(odometry=OdometryConfig(gyro_scale_std=GYRO_SCALE))

SKID = Robot(chi=1.5, rate=0.0, slip=0.02, outliers=0.0)
DIFFERENTIAL = Robot(chi=1.0, rate=0.0, slip=0.003, left=0.99, right=1.01, outliers=0.0)

LINKS = {"plain": (2, 3e-4), "checked": (2, 0.0), "counts": (9, 0.0)}
"""Decimals of the speeds and error of the sample times, s, by the kind of the link."""


class Set(Struct, frozen=True):
    """Robots of one kind, with the number and the length of the drives in the log of each robot."""

    robot: Robot
    drives: int = 1
    seconds: float = 90.0

    def log(self, rng: np.random.Generator, scale: float = 1.0) -> list[Drive]:
        """Return random drives for a log. The gyro's values are multiplied by `scale`."""
        made = [self.drive(rng, wander(rng, self.seconds)) for _ in range(self.drives)]
        return [replace(trip, gyro=trip.gyro * scale) for trip in made]

    def runs(self, log: Sequence[Drive], way: str) -> list[Run]:
        gyro, places = WAYS[way]
        return runs(log, gyro=gyro, places=places)

    def drive(self, rng: np.random.Generator, plan: Plan) -> Drive:
        return drive(replace(self.robot, rng=rng), plan)

    def track(self, log: Sequence[Drive]) -> float:
        """Return the true multiplier of the separation: the constant that fits the log best."""
        turns = np.abs(np.concatenate([np.diff(trip.yaw) for trip in log])) / 0.01
        return self.robot.chi * (1 + self.robot.rate * float(turns @ turns / turns.sum()))


def counting(robot: Robot, counts: int, link: str) -> Set:
    decimals, late = LINKS[link]
    return Set(replace(robot, counts=counts, decimals=decimals, period_noise=late))


SETS = {
    "skid, constant": Set(SKID),
    "skid, grows with the rate": Set(replace(SKID, rate=0.08)),
    "skid, 20 manoeuvres of 8 s": Set(replace(SKID, rate=0.08, slip=0.05), 20, 8.0),
    "skid, five minutes": Set(SKID, seconds=300.0),
    "skid, 16 counts, checked": counting(SKID, 16, "checked"),
    "skid, 96 counts, counts": counting(SKID, 96, "counts"),
    "differential": Set(DIFFERENTIAL),
    "differential, five minutes": Set(DIFFERENTIAL, seconds=300.0),
    "differential, 96 counts, plain": counting(DIFFERENTIAL, 96, "plain"),
}

ROWS = [
    ("skid, constant", "gyro"), ("skid, constant", "both"),
    ("skid, grows with the rate", "positions"), ("skid, 20 manoeuvres of 8 s", "gyro"),
    ("skid, 16 counts, checked", "gyro"), ("skid, 96 counts, counts", "gyro"),
    ("skid, five minutes", "positions"), ("differential", "gyro"), ("differential", "both"),
    ("differential, five minutes", "positions"), ("differential, 96 counts, plain", "both"),
]  # fmt: skip


def configs(log: Sequence[Run]) -> tuple[DriveConfig, OdometryConfig]:
    """Return the configuration that `--write` makes from the defaults and this log."""
    tables: dict[str, dict[str, float]] = {}
    for key, value in calibrate(Log(tuple(log), ()), CONFIG, "").settings.items():
        section, _, name = key.partition(".")
        tables.setdefault(section, {})[name] = value
    return (
        structs.replace(DriveConfig(), **tables.get("drive", {})),
        structs.replace(CONFIG.odometry, **tables.get("odometry", {})),
    )


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
        line = Line(AT, WheelSpeeds(right, left, left, right), 0.01 * LINES)
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
    default: float
    """NEES with the default noise."""
    heading: float
    """Mean square of the heading's error, in the variance that the odometry states."""
    distance: float
    error: float
    """Rms error of the heading after `PIECE` lines, deg."""
    best: float
    """The same error with the best track and radii."""
    track: float
    """Rms z of the track."""
    ratio: float
    """Rms z of the ratio of left to right."""


def measured(kind: Set, way: str, robots: int) -> Row:
    whole, default, tracks, ratios = (list[float]() for _ in range(4))
    pieces, turns = list[tuple[float, float]](), list[tuple[float, float, float]]()
    off: list[float] = []
    for seed in range(robots):
        rng = np.random.default_rng(9000 + seed)
        scale = 1.0 + rng.normal(0.0, GYRO_SCALE)
        log = kind.log(rng, scale)
        driven = kind.runs(log, way)
        robot, counts = configs(driven), kind.robot.counts
        found = fit(driven, CONFIG)
        left, right, track = (math.exp(found.p[index]) for index in (LEFT, RIGHT, TRACK))
        true = kind.track(log) / math.sqrt(kind.robot.left * kind.robot.right)
        tracks.append(math.log(track / math.sqrt(left * right) / true) / found.shares[0])
        true = kind.robot.right / kind.robot.left
        ratios.append(math.log(right / left / true) / found.shares[1])
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
        float(np.mean(whole)), float(np.mean(default)), heading, distance,
        math.degrees(rms(off)), math.degrees(rms(least)), rms(tracks), rms(ratios),
    )  # fmt: skip


def rms(values: Floats | Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "way"), ROWS)
def test_the_noise_of_a_calibration_describes_drives_outside_of_its_log(
    name: str, way: str
) -> None:
    row = measured(SETS[name], way, ROBOTS)
    print(
        f"\n| {name}; {way} | {row.nees:.1f} | {row.default:.2g} | {row.heading:.1f} | "
        f"{row.distance:.1f} | {row.error:.2f} | {row.best:.2f} | {row.error / row.best - 1:.0%} | "
        f"{row.track:.2f} | {row.ratio:.2f} |"
    )
    assert 0.3 < row.heading < 2.5
    assert row.nees < 7.0
    assert row.error < 1.4 * row.best
    assert row.track < 2.0
    assert row.ratio < 2.0


@pytest.mark.slow
def test_the_noise_of_a_calibration_describes_other_drives_of_two_robots() -> None:
    row = measured(SETS["skid, constant"], "gyro", 2)
    assert 0.3 < row.heading < 2.5
    assert row.error < 1.4 * row.best


LOG = runs(SETS["differential"].log(np.random.default_rng(1), 1.003))


@pytest.mark.slow
def test_the_noise_of_a_good_robot_is_found_and_then_stays() -> None:
    found = fit(LOG, Config())
    shown = noise(LOG, found, OdometryConfig())
    assert shown.heading_better
    assert shown.yaw_per_metre
    assert shown.yaw_per_radian
    assert shown.distance_per_metre
    assert shown.yaw_per_radian < 1e-3
    stated = structs.replace(
        OdometryConfig(), yaw_variance_per_metre=shown.yaw_per_metre,
        yaw_variance_per_radian=shown.yaw_per_radian,
        distance_variance_per_metre=shown.distance_per_metre,
        distance_scale_std=math.sqrt(shown.scale),
        wheel_separation_multiplier_std=math.sqrt(shown.track),
        wheel_radius_ratio_std=0.3 * math.sqrt(shown.ratio),
    )  # fmt: skip
    again = noise(LOG, found, stated)
    assert not again.heading_better
    assert not again.distance_better


@pytest.mark.parametrize(
    "way", ["gyro", pytest.param("places", marks=pytest.mark.slow), "headings"]
)
def test_a_sensor_that_is_late_shows_no_more_noise(way: str) -> None:
    found = []
    for late_s in (0.0, 0.4):
        log = Set(replace(DIFFERENTIAL, late=late_s)).log(np.random.default_rng(1))
        driven = runs(log, gyro=way == "gyro", places=way == "places")
        if way == "headings":
            driven = [by_headings(trip, late_s) for trip in log]
        found.append(noise(driven, fit(driven, Config()), OdometryConfig()))
    prompt, late = ((each.yaw_per_metre or 0.0) + (each.yaw_per_radian or 0.0) for each in found)
    assert 0.0 < late < 1.5 * prompt


def test_a_gyro_alone_shows_no_noise_of_the_distance() -> None:
    driven = runs(SETS["differential"].log(np.random.default_rng(1)), places=False)
    shown = noise(driven, fit(driven, Config()), OdometryConfig())
    assert shown.yaw_per_metre
    assert shown.distance_per_metre is None
    assert not shown.distance_better


LONG = motion(LEGS * 3)


@pytest.mark.parametrize(
    ("names", "seed"), [(("gyro",), 1), (("headings", "positions"), 0), (("positions",), 2)]
)
def test_the_noise_of_wheels_that_roll_by_chance_is_found(
    names: tuple[str, ...], seed: int
) -> None:
    # Variances of the heading and of the distance per metre, rad2/m and m2/m.
    per_metre, distance = (1e-3, 4e-4) if names == ("gyro",) else (1e-4, 1e-4)
    run, rng = sensed(*names, drive=LONG, late=0.2), np.random.default_rng(seed)
    left, right = RADIUS * np.diff(run.left), 1.01 * RADIUS * np.diff(run.right)
    turn, way = rng.normal(size=(2, len(left))) * np.sqrt(
        np.abs(left + right) / 2 * [[per_metre], [distance]]
    )
    track = 1.5 * SEPARATION
    angles = [
        np.append(0.0, np.cumsum(side + way + sign * turn * track / 2)) / radius
        for side, sign, radius in ((left, -1, RADIUS), (right, 1, 1.01 * RADIUS))
    ]
    run = structs.replace(run, left=angles[0], right=angles[1])
    shown = noise([run], fit([run], Config()), OdometryConfig())
    assert shown.heading_better
    assert 0.5 * per_metre < (shown.yaw_per_metre or 0.0) < 1.6 * per_metre
    assert (shown.yaw_per_radian or 1.0) < 0.2 * per_metre
    assert shown.track < 1e-4
    if "positions" in names:
        assert 0.6 * distance < (shown.distance_per_metre or 0.0) < 1.7 * distance
        assert shown.scale < 1e-5
    else:
        assert shown.distance_per_metre is None


# the least squares of the windows


def windows(count: int = 60, **variances: float) -> Floats:
    """Return rows of windows whose squared errors are exactly what their variances give."""
    rng = np.random.default_rng(1)
    roll, spin = rng.uniform(0.5, 5.0, count), rng.uniform(0.1, 9.0, count)
    way = spin * rng.uniform(-1.0, 1.0, count)
    features = np.array([roll, spin, way**2, roll**2, np.ones(count)]).T
    names = ("metre", "radian", "track", "ratio", "sensor")
    return np.column_stack((features, features @ [variances.get(name, 0.0) for name in names]))


ALL = {"metre": 1e-3, "radian": 2e-3, "track": 3e-4, "ratio": 4e-4, "sensor": 5e-3}


def test_each_source_of_noise_has_its_share() -> None:
    assert _solved(windows(60, **ALL)) == pytest.approx(list(ALL.values()), rel=0.2)
    for number, (name, value) in enumerate(ALL.items()):
        shares = _solved(windows(60, **{name: value}))
        assert shares[number] == pytest.approx(value, rel=0.01)
        assert np.delete(shares, number) == pytest.approx([0.0] * 4, abs=1e-5)


def test_single_windows_hardly_change_the_noise() -> None:
    table = windows(60, **ALL)
    table[::20, SQUARE] *= 1e4
    true = table[:, :SQUARE] @ [*ALL.values()]
    assert (table[:, :SQUARE] @ _solved(table)).mean() < 2.5 * true.mean()
    still = windows(metre=1e-3)
    still[:, 2] = 0.0  # a source that no window has is none
    assert _solved(still)[:3] == pytest.approx([1e-3, 0.0, 0.0], abs=1e-5)


def rows(table: Floats) -> _Rows:
    made = _Rows()
    for number, row in enumerate(table.tolist()):
        made.add(row, 5 * number // len(table))
    return made


def test_noise_is_better_if_it_explains_windows_that_it_was_not_fitted_to() -> None:
    rng = np.random.default_rng(2)
    table = windows(200, **ALL)
    table[:, SQUARE] *= rng.chisquare(1, len(table))
    true = np.array([*ALL.values()])
    for factor, better in ((1.0, False), (10.0, True), (0.1, True)):
        variances, found = _fitted(rows(table), factor * true)
        assert found is better
        assert (table[:, :SQUARE] @ variances).mean() == pytest.approx(
            (table[:, :SQUARE] @ true).mean(), rel=0.3
        )
    for count, known in ((20, False), (21, True)):
        variances, found = _fitted(rows(windows(count, **ALL)), 100 * true)
        assert bool(variances.any()) is known
        assert found is known
    made = rows(windows(20, **ALL))
    made.add(None, 0)
    made.add([math.nan] * 6, 0)
    assert len(made.rows) == len(made.groups) == 20


def test_the_likelihood_is_that_of_normal_errors_up_to_five_deviations() -> None:
    squares, variances = np.array([0.0, 4.0, 1e6]), np.array([1.0, 2.0, 2.0])
    assert _likelihood(squares, variances) == pytest.approx(-(2 * math.log(2) + 2 + 25) / 2)


def at_ends(**ends: tuple[float, float]) -> Path:
    """Return a path with these values at two times."""
    names = ("heading", "rolled", "turned", "x", "y")
    columns = tuple(np.array(ends.get(name, (0.0, 0.0))) for name in names)
    return cast("Path", SimpleNamespace(at=lambda t: columns))


def test_a_window_has_the_squares_of_its_errors() -> None:
    ends = np.zeros(2)
    path = at_ends(heading=(1.0, 1.5), rolled=(2.0, 5.0), turned=(1.0, 3.0))
    row = _heading(path, ends, 0.7)
    assert row == pytest.approx([3.0, 2.0, 0.25, 9.0, 1.0, 0.04])
    assert _heading(path, ends, 0.7 + math.tau) == pytest.approx(row)  # a wrapped heading
    assert _heading(at_ends(rolled=(2.0, 2.0009)), ends, 0.1) is None
    assert _heading(at_ends(rolled=(2.0, 2.0011)), ends, 0.1)
    path = at_ends(rolled=(1.0, 6.0), x=(1.0, 4.0), y=(0.0, 3.0))
    assert _distance(path, ends, 4j) == pytest.approx(
        [5.0, 0.0, 0.0, 25.0, 1.0, (4 - math.sqrt(18)) ** 2]
    )
    for way, straight in ((0.81, True), (0.79, False)):
        row = _distance(at_ends(rolled=(0.0, 1.0), x=(0.0, way)), ends, 1.0)
        assert (row is not None) is straight
    assert _distance(at_ends(rolled=(0.0, 0.019), x=(0.0, 0.019)), ends, 0.1) is None


def test_positions_bend_by_the_turn_of_a_half_window_to_the_other() -> None:
    t = np.arange(40.0)
    x = 0.3 * t
    straight: Any = SimpleNamespace(at=lambda t: (0 * x, x, 0.2 * x, x, 0 * x))
    bend = 0.05
    seen: Complexes = np.asarray(x, dtype=np.complex128)
    seen[20:] = seen[19] + (seen[20:] - seen[19]) * np.exp(1j * bend)
    row = _bend(straight, t, np.asarray((3 - 2j) + np.exp(0.4j) * seen))
    assert row
    roll, spin, way, rolled, sensor, square = row
    assert square == pytest.approx(bend**2)
    # A turn in the middle bends the whole, and one at an end bends nothing.
    assert spin / roll == pytest.approx(0.2)
    assert 0.5 * x[-1] / 2 < roll < x[-1]
    assert way == 0.0
    assert rolled == pytest.approx((0.5 * x[-1]) ** 2, rel=0.1)
    assert sensor == pytest.approx(2 / ((x[:20] - x[:20].mean()) ** 2).sum(), rel=0.01)
    assert _bend(straight, t[:7], seen[:7]) is None
    standing: Any = SimpleNamespace(at=lambda t: (0 * x,) * 5)
    assert _bend(standing, t, np.zeros_like(seen)) is None


def test_the_noise_is_compared_with_that_of_the_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Floats] = []

    def fitted(rows: _Rows, stated: Floats) -> tuple[Floats, bool]:
        seen.append(stated)
        return np.zeros(5), False

    monkeypatch.setattr(noises, "_fitted", fitted)
    odometry = OdometryConfig(
        yaw_variance_per_metre=1e-3, yaw_variance_per_radian=2e-3, distance_scale_std=0.03,
        wheel_separation_multiplier_std=0.1, wheel_radius_ratio_std=0.02,
        distance_variance_per_metre=5e-4,
    )  # fmt: skip
    found = fit([sensed("gyro")], Config())
    shown = noise([sensed("gyro")], found, odometry)
    # The track is 1.5 times the separation of 0.3 m, and its deviation is one of the multiplier.
    track = 0.3 * math.exp(found.p[TRACK])
    assert seen[0] == pytest.approx([1e-3, 2e-3, (0.1 * 0.3 / track) ** 2, (0.02 / track) ** 2, 0])
    assert seen[1] == pytest.approx([5e-4, 0.0, 0.0, 9e-4, 0.0])
    assert (shown.yaw_per_metre, shown.yaw_per_radian, shown.distance_per_metre) == (None,) * 3
    assert not shown.heading_better


def test_a_path_by_the_wheels_is_that_of_the_sensor() -> None:
    piece = Piece(sensed("positions"), Base.of(DriveConfig()))
    p = np.zeros(9)
    p[[TRACK, AHEAD, ASIDE]] = 0.4, 0.3, -0.1
    heading, rolled, turned, x, y = Path(piece, p).at(piece.t)
    place, yaw = piece.base.path(p, piece.left, piece.right)
    assert heading == pytest.approx(yaw)
    assert x + 1j * y == pytest.approx(place + (0.3 - 0.1j) * np.exp(1j * yaw))
    assert np.diff(rolled).min() >= 0.0
    assert (rolled[-1], turned[-1]) == pytest.approx((7.85, 20.3), rel=0.01)
