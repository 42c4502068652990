"""Tests of whole calibrations of simulated robots of each kind.

The heading must improve, and the standard deviations must cover the errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration import solve
from acsard.calibration.calibration_report import keys
from acsard.calibration.log_table import NoCalibrationError
from acsard.calibration.multipliers import Tape
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.calibration.solve import Calibration, calibrate
from acsard.core.config.settings import DriveConfig
from tests.unit.calibration.cut import calibrated, log_of_runs, table, usual
from tests.unit.calibration.robots import (
    GUIDED,
    RADIUS,
    SEPARATION,
    Drive,
    Floats,
    Plan,
    Robot,
    drive,
    slow_squares,
    wander,
)  # fmt: skip

WAYS = {"gyro": (True, False), "positions": (False, True), "both": (True, True)}

SQUARE: Plan = [
    (1, 0, 0), *[(3, 0.4, 0), (0.5, 0, 0), (2.5, 0, np.pi / 2 / 2.5 * 1.2), (0.5, 0, 0)] * 4,
]  # fmt: skip

FEW, MANY = 4, 20

each_way = pytest.mark.parametrize("way", WAYS)
so_many = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.soak)])


@cache
def robots(way: str, count: int) -> list[tuple[Calibration, Drive]]:
    """Return each robot's calibration and a random drive of five minutes.

    The calibration did not use the random drive.
    """
    gyro, places = WAYS[way]
    made = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        robot = Robot(rng=rng)
        plan = GUIDED if seed % 2 else wander(rng, 80.0)
        log = table(drive(robot, plan), gyro=gyro, places=places)
        made.append((calibrated(log), drive(robot, wander(rng, 300.0))))
    return made


def off(trip: Drive, values: Floats) -> float:
    """Return the rms error of the heading after 10 s with these parameters, rad."""
    track, left, right = values
    turns = (right * trip.right - left * trip.left) * RADIUS / (SEPARATION * track) * 0.01
    ends = np.arange(0, len(turns), 1000)
    error = np.diff(np.cumsum(turns)[ends]) - np.diff(trip.yaw[ends])
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.variations(3)
@so_many
@each_way
def test_heading_is_ten_times_better_than_geometric(way: str, count: int) -> None:
    better = [off(d, np.ones(3)) / off(d, c.multipliers.values) for c, d in robots(way, count)]
    print(f"{way}: heading {min(better):.1f} to {max(better):.1f} times better")
    assert min(better) >= 10


SETS: dict[str, tuple[float, float, float, Plan | None]] = {
    "constant track": (1.5, 0.0, 0.02, None),
    "growing track": (1.5, 0.08, 0.02, None),
    "no skidding": (1.0, 0.0, 0.003, None),
    "squares": (1.2, 0.0, 0.01, SQUARE),
}
"""Sets of drives: `chi`, `rate` and `slip` of the robot, and the plan, or None for 90 s at random.

The squares are six runs, three of them to each side.
"""

SUBSETS = 20


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("kind", "way"),
    [("constant track", "gyro"), ("growing track", "gyro"), ("no skidding", "gyro"),
     ("squares", "gyro"), *(pytest.param(kind, "positions", marks=pytest.mark.soak)
                            for kind in ("constant track", "squares"))],
)  # fmt: skip
def test_standard_deviations_are_as_wide_as_the_errors(kind: str, way: str) -> None:
    """A track that grows with the turn rate has no single true value.

    The test uses the constant that fits the drive's turn rates best. Each run of squares has its
    own ratio of left to right, because it slips differently.
    """
    chi, rate, slip, plan = SETS[kind]
    gyro, places = WAYS[way]
    tracks, ratios = [], []
    for seed in range(SUBSETS):
        rng = np.random.default_rng(seed)
        robot = Robot(chi=chi, rate=rate, slip=slip, left=0.99, right=1.01, rng=rng, outliers=0.0)
        scale = 1.0 + rng.normal(0.0, 0.005)  # of the gyro
        drives = [drive(robot, wander(rng, 90.0))] if plan is None else []
        for side in (1, -1) * 3 if plan else ():
            apart = rng.normal(0.0, 0.004, 2)
            other = replace(robot, left=0.99 + apart[0], right=1.01 + apart[1])
            drives.append(drive(other, [(s, v, side * w) for s, v, w in plan or ()]))
        drives = [replace(trip, gyro=trip.gyro * scale) for trip in drives]
        calibration = calibrated(log_of_runs(drives, gyro=gyro, places=places))
        turns = np.abs(np.concatenate([np.diff(trip.yaw) for trip in drives])) / 0.01
        true = chi * (1 + rate * float(turns @ turns / turns.sum()))
        tracks.append((calibration.multipliers.values[0] - true) / calibration.multipliers.std[0])
        if RATIO not in calibration.stays_configured:
            off = np.log(
                calibration.multipliers.values[2] / calibration.multipliers.values[1] * 0.99 / 1.01
            )
            ratios.append(off / calibration.multipliers.relative_deviations().ratio)
    track, ratio = (float(np.sqrt(np.mean(np.square(z)))) for z in (tracks, ratios))
    print(f"{kind}, {way}: rms z {track:.2f} of the track, {ratio:.2f} of left to right")
    least = 0.7 if way == "gyro" else 0.5
    assert least < track < 1.4
    assert least < ratio < 1.4


@pytest.mark.variations(3)
@so_many
@each_way
def test_the_reported_remaining_error_is_the_error_that_remains(way: str, count: int) -> None:
    for c, _ in robots(way, count):
        worth = c.improvement
        for error in (worth.heading, worth.place):
            assert error.after is None or error.after < (error.before or 0.0) / 4
        if way != "positions":
            assert worth.turn.before == pytest.approx(240, abs=25)
            assert (worth.turn.after or math.inf) < 24


def away(drives: Sequence[Drive], values: Floats) -> float:
    """Return the rms position error of wheel odometry over whole drives, m.

    The odometry starts at the true position and heading of each drive.
    """
    squares = []
    for trip in drives:
        track, left, right = values
        fast, quick = left * trip.left * RADIUS * 0.01, right * trip.right * RADIUS * 0.01
        yaw = np.cumsum((quick - fast) / (SEPARATION * track))
        where = np.cumsum((quick + fast) / 2 * np.exp(1j * yaw))
        squares.append(np.mean(np.abs(where - trip.where) ** 2))
    return float(np.sqrt(np.mean(squares)))


def slow_drives(seed: int, **other: float) -> list[Drive]:
    """Return drives of slow squares by a robot with motion capture of 1.6 mm at 20 Hz."""
    fixed: dict[str, float] = {"chi": 1.0, "rate": 0.0, "outliers": 0.0, "slip": 0.003}
    fixed |= {"left": 1.0, "right": 1.0, "place_noise": 0.0016, "place_hz": 20.0}
    robot = Robot(rng=np.random.default_rng(seed), **(fixed | other))  # type: ignore[arg-type]
    return [drive(robot, slow_squares(turn=turn)) for turn in (0.3, -0.3) * 2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 6])
def test_slow_squares_do_not_worsen_the_odometry_of_a_sound_robot(seed: int) -> None:
    """The wheels' errors hide small turns in short blocks.

    A fit to such blocks makes the track too wide.
    """
    log = log_of_runs(slow_drives(seed, wheel_noise=0.05), gyro=False)
    elsewhere = slow_drives(seed + 100, wheel_noise=0.05)
    before = after = away(elsewhere, np.ones(3))
    try:
        after = away(elsewhere, calibrated(log).multipliers.values)
    except NoCalibrationError as refused:
        assert "not clearly better" in str(refused)  # noqa: PT017
    print(f"{100 * before:.1f} cm before, {100 * after:.1f} cm after")
    assert after <= before


@pytest.mark.slow
def test_slow_squares_improve_the_odometry_of_a_miscalibrated_robot() -> None:
    fixed = {"chi": 1.1, "left": 0.98, "right": 1.02, "wheel_noise": 0.02}
    values = calibrated(log_of_runs(slow_drives(0, **fixed), gyro=False)).multipliers.values
    elsewhere = slow_drives(100, **fixed)
    assert away(elsewhere, values) < away(elsewhere, np.ones(3)) / 4


def manoeuvres(seed: int, count: int, slip: float) -> list[Drive]:
    """Return drives of about 6 s by a skid-steer robot, with two curves each."""
    rng = np.random.default_rng(seed)
    robot = Robot(chi=1.9, rate=0.1, slip=slip, left=1.0, right=1.0, rng=rng)
    spans = ((2.0, 4.0), (3.0, 3.0))
    return [
        drive(robot, [(float(rng.uniform(*s)), *rng.uniform((0, -1.6), (0.5, 1.6))) for s in spans])
        for _ in range(count)
    ]


def turned_wrong(drives: Sequence[Drive], track: float) -> float:
    """Return the error of the heading divided by the turned angle."""
    off = angle = 0.0
    for trip in drives:
        turns = (trip.right - trip.left) * RADIUS / (SEPARATION * track) * 0.01
        off, angle = off + abs(turns.sum() - trip.yaw[-1]), angle + abs(trip.yaw[-1])
    return off / angle


@pytest.mark.parametrize("seed", range(3))
def test_ten_manoeuvres_of_a_skidding_robot_give_its_track(seed: int) -> None:
    """The drives determine the ratio of the radii only to 6 to 8 %, so it stays as configured."""
    calibration = calibrated(log_of_runs(manoeuvres(seed, 10, 0.1), places=False))
    assert calibration.stays_configured == (RATIO,)
    assert calibration.multipliers.values[1:].tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
    assert any(
        "the right to the left wheel radius stays as configured" in note
        for note in calibration.notes
    )
    elsewhere = manoeuvres(seed + 1000, 40, 0.1)
    best = min(turned_wrong(elsewhere, track) for track in np.arange(1.0, 3.0, 0.02))
    error = turned_wrong(elsewhere, calibration.multipliers.values[0])
    print(f"{turned_wrong(elsewhere, 1.0):.1%} as configured, {error:.1%} found, {best:.1%} best")
    assert error < 1.15 * best


def test_turns_on_the_spot_give_the_track_by_a_gyro() -> None:
    trip = drive(Robot(rng=np.random.default_rng(0)), [(3, 0, 0), (20, 0, 1), (20, 0, -1)])
    calibration = calibrated(table(trip, places=False))
    assert calibration.stays_configured == (RATIO,)
    assert calibration.multipliers.values[0] == pytest.approx(1.6 * (1 + 0.08 / 1.73), rel=0.02)


def test_a_log_is_refused_with_the_quantities_that_are_too_inaccurate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Turns on the spot do not determine the ratio of the radii at all."""
    monkeypatch.setattr(solve, "MAX_LOG_STDS", {TRACK: 1e-9, RATIO: 0.03})
    plan: Plan = [(3, 0, 0), (20, 0, 1), (20, 0, -1)]
    with pytest.raises(NoCalibrationError) as refused:
        calibrated(table(drive(Robot(rng=np.random.default_rng(0)), plan), places=False))
    text = str(refused.value)
    assert "this log is too inaccurate: " in text
    assert f"{RATIO} cannot be determined" in text
    assert "inf" not in text


def test_turns_on_the_spot_with_one_faster_side_give_the_track_by_a_gyro() -> None:
    """The left wheels always roll 1 % less than the right wheels."""
    plan: Plan = [(3, 0, 0), (20, 0.00075, 1), (20, -0.00075, -1)]
    calibration = calibrated(table(drive(Robot(rng=np.random.default_rng(0)), plan), places=False))
    assert calibration.stays_configured == (RATIO,)
    assert calibration.multipliers.values[0] == pytest.approx(1.6 * (1 + 0.08 / 1.73), rel=0.02)


def test_a_tape_measures_the_wheels_of_a_robot_whose_track_is_right() -> None:
    trip = usual()
    first = calibrated(table(trip, places=False)).multipliers.values
    ahead = drive(Robot(rng=np.random.default_rng(1)), [(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    right = DriveConfig(
        wheel_separation_multiplier=float(first[0]),
        left_wheel_radius_multiplier=float(first[1]), right_wheel_radius_multiplier=float(first[2]),
    )  # fmt: skip
    log = log_of_runs([trip, ahead], places=False)
    calibration = calibrate(log, right, Tape(1.1 * float(abs(ahead.where[-1])), "2"))
    assert set(calibration.stays_configured) == {TRACK, RATIO}
    assert calibration.multipliers.values / first == pytest.approx([1.1] * 3, rel=0.01)
    settings = keys(calibration)
    assert settings["odometry.distance_scale_std"] == pytest.approx(0.0025, abs=0.001)


@pytest.mark.slow
def test_a_tape_measures_the_wheels_if_positions_are_too_coarse_to_improve_them() -> None:
    robot = Robot(place_noise=0.2, rng=np.random.default_rng(1))
    trip, ahead = drive(robot, GUIDED), drive(robot, [(2, 0, 0), (8, 0.3, 0), (2, 0, 0)])
    large = DriveConfig(
        wheel_separation_multiplier=1.688, left_wheel_radius_multiplier=1.02 * 0.998,
        right_wheel_radius_multiplier=1.02 * 1.002,
    )  # fmt: skip
    calibration = calibrate(
        log_of_runs([trip, ahead], gyro=False), large, Tape(abs(ahead.where[-1]), "2")
    )
    assert set(calibration.stays_configured) == {TRACK, RATIO}
    assert calibration.multipliers.values[1:] == pytest.approx([0.998, 1.002], abs=0.01)
    assert calibration.scale == "distance"
    assert calibration.odometry["distance_scale_std"] == pytest.approx(0.004, abs=0.002)


def test_a_log_whose_sensors_have_no_value_is_refused() -> None:
    with pytest.raises(NoCalibrationError, match="no positions or turn rates"):
        calibrated(table(usual(), gyro=False, places=False))


@so_many
def test_bias_and_time_offset_are_reported(count: int) -> None:
    for c, _ in robots("gyro", count):
        assert c.gyro_bias == pytest.approx(0.01, abs=0.002)
        assert c.delays["yaw_rate"] == pytest.approx(0.02, abs=0.012)


@pytest.mark.slow
def test_an_uncertain_bias_widens_the_deviation_of_left_to_right() -> None:
    """A gyro bias looks like a curve to one side that is equal in every block."""
    z = []
    for seed in range(12):
        robot = Robot(gyro_noise=0.06, slip=0.003, rng=np.random.default_rng(seed))
        result = calibrated(table(drive(robot, wander(robot.rng, 100.0)), places=False)).multipliers
        logs = result.covariance / np.outer(result.values, result.values)
        apart = np.array([0.0, -1.0, 1.0])
        off = np.log(result.values) @ apart - np.log(1.002 / 0.998)
        z.append(off / np.sqrt(apart @ logs @ apart))
    assert np.sqrt(np.mean(np.square(z))) < 1.4


def test_coarse_encoders_at_a_high_rate_do_not_distort_the_track() -> None:
    """At 1 kHz a wheel with 20 counts per turn reports 0 or 314 rad/s.

    The mean square of these speeds is therefore no measure of the true speed.
    """
    trip = usual(plan=wander(np.random.default_rng(2), 100.0))
    t = np.arange(trip.t[0], trip.t[-1], 0.001)
    counted = [
        np.floor(np.interp(t, trip.t, np.cumsum(side) * 0.01) * 20 / (2 * np.pi))
        for side in (trip.left, trip.right)
    ]
    left, right = (np.diff(counts) * 2 * np.pi / 20 / 0.001 for counts in counted)
    coarse = replace(trip, t=t[1:], left=left, right=right)
    result = calibrated(table(coarse, places=False)).multipliers
    assert result.values[0] == pytest.approx(1.6 * 1.05, rel=0.06)


@pytest.mark.variations(2)
@pytest.mark.parametrize("places", [False, True])
def test_the_deviation_of_the_track_covers_a_scale_error_of_the_gyro(places: bool) -> None:
    """A scale error of 1 % is normal for a gyro. Only positions reveal it."""
    robot = Robot(rate=0.0, slip=0.002, place_noise=0.003, rng=np.random.default_rng(1))
    trip = drive(robot, wander(robot.rng, 300.0))
    result = calibrated(table(replace(trip, gyro=trip.gyro * 1.01), places=places)).multipliers
    assert abs(result.values[0] - 1.6) < 2.2 * result.std[0]
    assert result.std[0] < 0.016
    if places:
        assert result.values[0] == pytest.approx(1.6, rel=0.006)


@pytest.mark.slow
def test_the_remaining_turn_error_uses_the_gyro_with_its_scale_corrected() -> None:
    robot = Robot(rate=0.0, slip=0.002, place_noise=0.003, rng=np.random.default_rng(1))
    trip = drive(robot, wander(robot.rng, 300.0))
    worth = calibrated(table(replace(trip, gyro=trip.gyro * 1.02))).improvement
    assert (worth.turn.after or math.inf) < 3.0  # deg in 360; 2 % of that are 7 deg


@pytest.mark.slow
def test_positions_that_do_not_show_the_direction_do_not_contradict_the_gyro() -> None:
    """The robot drives one small square.

    Pieces of four seconds therefore show only straight lines and noise.
    """
    side: Plan = [(4, 0.3, 0), (0.5, 0, 0), (4, 0, np.pi / 2 * 1.5 / 4), (0.5, 0, 0)]
    robot = Robot(chi=1.5, rate=0.0, outliers=0.0, lever=0j, rng=np.random.default_rng(3))
    result = calibrated(table(drive(robot, [(3, 0, 0), *side * 4, (3, 0, 0)]))).multipliers
    assert result.values[0] == pytest.approx(1.5, rel=0.05)


AHEAD: Plan = [
    (6, 0.4, 0), (8, 0.3, 1.2), (6, 0.5, 0), (8, 0.3, 0.5), (6, 0.2, -0.6), (8, 0.4, 1.4),
] * 2  # fmt: skip
"""The robot never rests, always drives forward and mostly turns left, so no mean is zero."""


def test_a_log_without_a_rest_gives_the_same_drive_statistics_and_turn_error() -> None:
    rests: Plan = [(3, 0, 0), *AHEAD, (3, 0, 0)]
    moving, resting = (
        calibrated(table(drive(Robot(rng=np.random.default_rng(4)), plan), places=False))
        for plan in (AHEAD, rests)
    )
    assert moving.drives.metres == pytest.approx(resting.drives.metres, rel=0.02)
    assert moving.drives.turns == pytest.approx(resting.drives.turns, rel=0.06)
    assert moving.drives.fastest == pytest.approx(resting.drives.fastest, rel=0.1)
    assert moving.improvement.turn.before == pytest.approx(resting.improvement.turn.before, rel=0.1)
    assert moving.gyro_bias == pytest.approx(0.01, abs=0.01)


def test_a_tape_measures_the_wheels() -> None:
    robot = Robot(left=0.948, right=0.952, rng=np.random.default_rng(2))
    straight = drive(robot, [(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    text = drive(robot, GUIDED).csv(places=False, run="turns")
    text += straight.csv(places=False, run="straight").partition("\n")[2]
    made = calibrated(text, Tape(abs(straight.where[-1])))
    z = (made.multipliers.values[1:] - [0.948, 0.952]) / made.multipliers.std[1:]
    assert np.all(np.abs(z) < 3)
    assert made.multipliers.values[0] == pytest.approx(1.6 * 1.04, rel=0.03)
    assert made.scale == "distance"


@pytest.mark.slow
@each_way
def test_much_slip_widens_the_deviation_and_is_not_refused(way: str) -> None:
    gyro, places = WAYS[way]
    rng = np.random.default_rng(5)
    made = drive(Robot(slip=0.05, rng=rng), wander(rng, 120.0))
    result = calibrated(table(made, gyro=gyro, places=places)).multipliers
    assert abs(result.values[0] - 1.6 * 1.04) < 2 * result.std[0]


@pytest.mark.slow
def test_coarse_positions_are_compared_over_a_longer_time() -> None:
    rng = np.random.default_rng(5)
    made = drive(Robot(place_noise=0.7, outliers=0.0, rng=rng), wander(rng, 600.0))
    result = calibrated(table(made, gyro=False)).multipliers
    assert abs(result.values[0] - 1.6 * 1.045) < 2 * result.std[0]


@pytest.mark.slow
def test_order_repetition_and_standstill_do_not_change_the_multipliers() -> None:
    made = drive(Robot(rng=np.random.default_rng(4)), [(200, 0, 0), *GUIDED, (100, 0, 0)], 1.7e9)
    head, *body = made.csv(places=False).splitlines()
    mixed = list(np.random.default_rng(1).permutation(body + body[:500]))
    plain = calibrated("\n".join([head, *body])).multipliers
    other = calibrated("\n".join([head, *mixed])).multipliers
    assert np.allclose(plain.values, other.values, atol=1e-9)


@pytest.mark.slow
def test_gaps_and_jumps_are_reported_and_cost_little() -> None:
    made = usual()
    mask = np.sin(made.t / 7) > -0.6
    jumped = made.place + np.where(made.place_t > 40, 30 - 20j, 0)
    torn = replace(made, t=made.t[mask], left=made.left[mask], right=made.right[mask], place=jumped)
    calibration = calibrated(table(torn))
    assert any("gaps" in note for note in calibration.notes)
    assert any("jump" in note for note in calibration.notes)
    assert calibration.multipliers.values[0] == pytest.approx(1.6 * 1.04, rel=0.03)


SPIN = [(3, 0, 0), (40, 0, 1)]
TOO_LITTLE = [[(3, 0, 0), (30, 0.3, 0)], [(3, 0, 0), (60, 0.3, 0.8)], [(60, 0, 0)]]


@pytest.mark.parametrize(
    ("way", "plan"),
    [*((way, plan) for plan in TOO_LITTLE for way in WAYS), ("positions", SPIN), ("both", SPIN)],
)
def test_a_drive_with_too_few_movements_is_refused(way: str, plan: list[tuple[float, ...]]) -> None:
    gyro, places = WAYS[way]
    with pytest.raises(NoCalibrationError, match="a drive of 60 s"):
        calibrated(table(drive(Robot(), plan), gyro=gyro, places=places))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_log_of_a_million_rows_is_calibrated() -> None:
    rng = np.random.default_rng(1)
    text = drive(Robot(rng=rng), wander(rng, 4900.0)).csv()
    assert text.count("\n") > 1_000_000
    assert calibrated(text).multipliers.values[0] == pytest.approx(1.6 * 1.045, rel=0.02)


def test_positions_that_agree_too_well_are_named_unless_they_are_the_simulators_true_pose() -> None:
    robot = Robot(place_noise=0.0, outliers=0.0, lever=0j, slip=0.0, late=0.0, decimals=9)
    log = log_of_runs([drive(robot, GUIDED)], gyro=False)
    note = "these values agree better with the wheels than a sensor can"
    assert any(note in line for line in calibrate(log, DriveConfig()).notes)
    true = structs.replace(log, true_positions=True)
    assert not any(note in line for line in calibrate(true, DriveConfig()).notes)
