"""Tests of the fit with simulated robots of each kind.

The heading must improve on other drives, and the standard deviations must cover the errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration.comparison import Match
from acsard.calibration.fit import (
    AHEAD,
    ASIDE,
    BIAS,
    GYRO_DELAY,
    POSE_DELAY,
    SCALE,
    Errors,
    Fit,
    Piece,
    aligned,
    centered,
    cut,
    fit,
    moves,
)  # fmt: skip
from acsard.calibration.geometry import LEFT, RIGHT, TRACK, Base, path
from acsard.calibration.log import LogError, Notes, Run, TapeReading, run_of
from acsard.core.config.settings import Config, DriveConfig, OdometryConfig
from tests.unit.calibration_bags import motion
from tests.unit.calibration_logs import (
    IDEAL,
    WAYS,
    by_headings,
    fitted,
    ideal,
    multipliers,
    run,
    usual,
)
from tests.unit.calibration_robots import (
    GUIDED,
    RADIUS,
    SEPARATION,
    Drive,
    Floats,
    Robot,
    drive,
    slow_square,
    wander,
)  # fmt: skip
from tests.unit.test_calibration_matches import LEGS
from tests.unit.test_calibration_matches import log as sensed

each_way = pytest.mark.parametrize("way", WAYS)


def off(trip: Drive, values: Floats) -> float:
    """Return the rms error of the heading after 10 s with these multipliers, rad."""
    track, left, right = values
    turns = (right * trip.right - left * trip.left) * RADIUS / (SEPARATION * track) * 0.01
    ends = np.arange(0, len(turns), 1000)
    error = np.diff(np.cumsum(turns)[ends]) - np.diff(trip.yaw[ends])
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.slow
@each_way
def test_heading_is_ten_times_better_than_with_the_geometric_track(way: str) -> None:
    gyro, places = WAYS[way]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        robot = Robot(rng=rng)
        found = fitted(
            drive(robot, GUIDED if seed % 2 else wander(rng, 80.0)), gyro=gyro, places=places
        )
        other = drive(robot, wander(rng, 200.0))
        better = off(other, np.ones(3)) / off(other, multipliers(found))
        print(f"{way}: heading {better:.1f} times better")
        assert found.better
        assert better >= 10


@pytest.mark.variations(3)
@each_way
def test_a_perfect_robot_is_found_exactly(way: str) -> None:
    gyro, places = WAYS[way]
    found = fitted(ideal(), gyro=gyro, places=places)
    track, left, right = multipliers(found)
    assert track / (left + right) * 2 == pytest.approx(1.6, rel=3e-4)
    assert right / left == pytest.approx(1.002 / 0.998, abs=3e-4)
    assert not places or left == pytest.approx(0.998, abs=3e-4)


GOOD_GYRO = Config(odometry=OdometryConfig(gyro_scale_std=0.004))
SETS = {"constant track": (1.5, 0.02), "no skidding": (1.0, 0.003), "manoeuvres": (1.9, 0.05)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SETS)
def test_standard_deviations_are_as_wide_as_the_errors(kind: str) -> None:
    """The gyro has a scale error of 0.4 %, which is configured: part of the track's deviation."""
    chi, slip = SETS[kind]
    tracks, ratios = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        robot = Robot(chi=chi, rate=0.0, slip=slip, left=0.99, right=1.01, rng=rng)
        scale = 1.0 + rng.normal(0.0, 0.004)
        short = kind == "manoeuvres"
        drives = [
            drive(robot, wander(rng, 8.0 if short else 90.0)) for _ in range(12 if short else 1)
        ]
        drives = [replace(trip, gyro=trip.gyro * scale) for trip in drives]
        found = fitted(*drives, places=False, config=GOOD_GYRO)
        track, left, right = np.log(multipliers(found))
        tracks.append((track - (left + right) / 2 - np.log(chi)) / found.shares[0])
        ratios.append((right - left - np.log(1.01 / 0.99)) / found.shares[1])
    track, ratio = (float(np.sqrt(np.mean(np.square(z)))) for z in (tracks, ratios))
    print(f"{kind}: rms z {track:.2f} of the track, {ratio:.2f} of left to right")
    assert 0.5 < track < 1.4
    assert 0.5 < ratio < 1.4


def away(drives: Sequence[Drive], values: Floats) -> float:
    """Return the rms position error of wheel odometry over whole drives, m."""
    squares = []
    for trip in drives:
        track, left, right = values
        fast, quick = left * trip.left * RADIUS * 0.01, right * trip.right * RADIUS * 0.01
        yaw = np.cumsum((quick - fast) / (SEPARATION * track))
        where = np.cumsum((quick + fast) / 2 * np.exp(1j * yaw))
        squares.append(np.mean(np.abs(where - trip.where) ** 2))
    return float(np.sqrt(np.mean(squares)))


def test_runs_that_differ_widen_the_deviation_by_their_own_spread() -> None:
    still, curves = (3.0, 0.0, 0.0), [(12.0, 0.3, 0.5), (12.0, 0.3, -0.5)]
    sound = replace(Robot(), **(IDEAL | {"gyro_noise": 0.004}))  # type: ignore[arg-type]
    made = [
        drive(replace(sound, left=1 + part, right=1 - part), [still, *curves, still])
        for part in (0.01, -0.01, 0.01, -0.01)
    ]
    # The ratio of the radii is 1 +- 0.023 from run to run, so that of four is 1 +- 0.012.
    assert 0.011 < fitted(*made, places=False).shares[1] < 0.016


def slow_drives(seed: int, **other: float) -> list[Drive]:
    """Return drives of slow squares by a robot with motion capture of 1.6 mm at 20 Hz."""
    fixed: dict[str, float] = {"chi": 1.0, "rate": 0.0, "outliers": 0.0, "slip": 0.003}
    fixed |= {"left": 1.0, "right": 1.0, "place_noise": 0.0016, "place_hz": 20.0}
    robot = Robot(rng=np.random.default_rng(seed), **(fixed | other))  # type: ignore[arg-type]
    return [drive(robot, slow_square(turn)) for turn in (0.3, -0.3) * 2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 6])
def test_slow_squares_do_not_worsen_the_odometry_of_a_sound_robot(seed: int) -> None:
    found = fitted(*slow_drives(seed, wheel_noise=0.05), gyro=False)
    elsewhere = slow_drives(seed + 100, wheel_noise=0.05)
    before = away(elsewhere, np.ones(3))
    after = away(elsewhere, multipliers(found)) if found.better else before
    print(f"{100 * before:.1f} cm before, {100 * after:.1f} cm after")
    assert after <= 1.02 * before


@pytest.mark.slow
def test_slow_squares_improve_the_odometry_of_a_miscalibrated_robot() -> None:
    fixed = {"chi": 1.1, "left": 0.98, "right": 1.02, "wheel_noise": 0.02}
    found = fitted(*slow_drives(0, **fixed), gyro=False)
    elsewhere = slow_drives(100, **fixed)
    assert found.better
    assert away(elsewhere, multipliers(found)) < away(elsewhere, np.ones(3)) / 4


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
def test_ten_manoeuvres_of_6_s_give_the_track_of_a_robot_that_skids_much(seed: int) -> None:
    found = fitted(*manoeuvres(seed, 10, 0.1), places=False)
    elsewhere = manoeuvres(seed + 1000, 40, 0.1)
    best = min(turned_wrong(elsewhere, track) for track in np.arange(1.0, 3.0, 0.02))
    error = turned_wrong(elsewhere, multipliers(found)[0])
    print(f"{turned_wrong(elsewhere, 1.0):.1%} as configured, {error:.1%} found, {best:.1%} best")
    assert found.better
    assert error < 1.15 * best
    assert found.shares[1] > 0.01  # the ratio of the radii is hardly shown


def test_what_a_log_does_not_show_stays_as_configured_with_the_deviation_of_the_prior() -> None:
    """Turns in place by a gyro show neither the size of the wheels nor their ratio."""
    trip = drive(Robot(rng=np.random.default_rng(0)), [(3, 0, 0), (20, 0, 1), (20, 0, -1)])
    found = fitted(trip, places=False)
    track, left, right = multipliers(found)
    assert track == pytest.approx(1.6 * (1 + 0.08 / 1.73), rel=0.02)
    assert (left, right) == pytest.approx((1.0, 1.0), abs=0.002)
    assert found.shares[2] == pytest.approx(0.014, abs=0.002)
    assert not found.sized


def test_a_distance_by_tape_shows_the_size_of_the_wheels() -> None:
    ahead = drive(Robot(rng=np.random.default_rng(1)), [(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    metres = 1.05 * float(abs(ahead.where[-1]))
    straight = structs.replace(
        run(ahead, gyro=False, places=False), tape=(TapeReading("distance", metres, 0.01),)
    )
    found = fit([run(usual(), places=False), straight], Config())
    assert multipliers(found)[1:] == pytest.approx([1.05, 1.05], rel=0.01)
    assert found.sized
    assert found.shares[2] < 0.005


def test_a_gyro_that_is_late_biased_and_interrupted_gives_the_same_track() -> None:
    trip = drive(Robot(late=0.3, bias=0.03, rng=np.random.default_rng(3)), GUIDED)
    kept = np.abs((trip.gyro_t % 20) - 10) > 0.7
    found = fitted(replace(trip, gyro_t=trip.gyro_t[kept], gyro=trip.gyro[kept]), places=False)
    assert found.p[GYRO_DELAY] == pytest.approx(0.3, abs=0.02)
    assert found.p[BIAS] == pytest.approx(0.03, abs=0.002)
    expected = multipliers(fitted(usual(), places=False))[0]
    assert multipliers(found)[0] == pytest.approx(expected, rel=0.01)


def test_headings_alone_show_no_size_of_the_wheels() -> None:
    trip, rng = usual(), np.random.default_rng(2)
    noisy = replace(trip, yaw=trip.yaw + rng.normal(0.0, 0.004, len(trip.yaw)))
    found = fit([by_headings(noisy, 0.0)], Config())
    assert not found.sized
    assert found.shares[2] > 0.012  # of both radii alike, as before the log


def test_headings_that_are_late_give_the_same_track() -> None:
    same_but_for_a_delay(*(fit([by_headings(usual(), late)], Config()) for late in (0.0, 0.3)))


def same_but_for_a_delay(prompt: Fit, late: Fit) -> None:
    assert late.p[POSE_DELAY] - prompt.p[POSE_DELAY] == pytest.approx(0.3, abs=0.02)
    assert multipliers(late) == pytest.approx(multipliers(prompt), rel=0.01)


def test_a_log_without_a_sensor_beside_the_wheels_is_refused() -> None:
    with pytest.raises(LogError, match="no gyro and no positions"):
        fitted(usual(), gyro=False, places=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_one_drive_of_55_s_by_positions_is_nearly_as_good_as_the_best_fit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = Robot(
        chi=1.15, rate=0.02, left=1.056, right=1.049, place_noise=0.003, place_hz=20.0,
        outliers=0.0, rng=rng,
    )  # fmt: skip
    trip = drive(robot, wander(rng, 55.0))
    found, whole = fitted(trip, gyro=False), Piece(run(trip, gyro=False), Base.of(Config().drive))
    free = [LEFT, RIGHT, TRACK, POSE_DELAY, AHEAD, ASIDE]

    def off(p: Floats) -> Floats:
        e = whole.residuals(p)["positions"]
        return np.where(np.isfinite(e), e, 0.0)

    best = found.p.copy()
    for _ in range(8):
        steps = 1e-5 * np.eye(len(best))[free]
        columns = np.array([(off(best + step) - off(best)) * 1e5 for step in steps])
        best[free] -= np.clip(np.linalg.lstsq(columns.T, off(best), rcond=None)[0], -0.05, 0.05)
    rms = [float(np.sqrt(np.mean(off(p) ** 2))) for p in (found.p, best)]
    print(f"{1000 * rms[0]:.1f} mm found, {1000 * rms[1]:.1f} mm best")
    assert rms[0] < 1.5 * rms[1]


def test_the_place_and_the_delay_of_a_sensor_have_their_sign() -> None:
    found = fit([sensed("positions", lever=0.1 + 0.05j, late=0.2)], Config())
    assert found.p[[POSE_DELAY, AHEAD, ASIDE]] == pytest.approx([0.2, 0.1, 0.05], abs=0.004)
    assert multipliers(found) == pytest.approx([1.5, 1.0, 1.01], abs=0.001)
    assert found.tracked
    assert found.shares == pytest.approx([0.004, 0.004, 0.001], rel=0.5)


def test_positions_that_jump_move_the_values_by_little_and_widen_them() -> None:
    run = sensed("positions", lever=0.1 + 0.05j)
    run.place[::20] += 0.3
    found = fit([run], Config())
    assert multipliers(found) == pytest.approx([1.5, 1.0, 1.01], abs=0.001)
    assert found.shares == pytest.approx([0.010, 0.0085, 0.0025], rel=0.5)


def test_long_runs_are_cut_and_each_piece_may_be_left_out() -> None:
    found = fit([sensed("gyro", name=str(n), drive=PARTS[n]) for n in range(4)], Config())
    assert len(found.pieces) > 4  # they are cut, so that there are twelve
    assert {piece.run.name for piece in found.pieces} == {"0", "1", "2", "3"}
    assert multipliers(found)[0] == pytest.approx(1.4925, abs=0.004)
    first = np.array([piece.run.name == "0" for piece in found.pieces])
    assert found.without(first) == pytest.approx(found.p, abs=0.01)
    assert np.any(found.without(first) != found.p)


PARTS = [motion([(2, 0, 0), *LEGS[at : at + 3], (2, 0, 0)]) for at in (1, 3, 5, 7)]


def test_points_are_aligned_without_the_wrong_ones() -> None:
    rng = np.random.default_rng(1)
    model = np.exp(1j * np.linspace(0.0, 3.0, 60)) + np.linspace(0.0, 2.0, 60)
    noise = 0.001 * rng.normal(size=(2, 60))
    seen = (2 - 3j) + np.exp(0.7j) * (model + noise[0] + 1j * noise[1])
    seen[[10, 40]] += 5.0, 3j
    found = aligned(seen, model)
    assert np.angle(found.turn) == pytest.approx(0.7, abs=0.001)
    assert abs(found.turn) == pytest.approx(1.0)
    sound = np.delete(np.abs(found.off), [10, 40])
    assert sound.max() < 0.01
    assert found.weight[[10, 40]].max() < 0.01
    assert abs(found.off[10] - 5.0 * np.exp(-0.7j)) < 0.02


def test_values_are_centered_without_the_wrong_ones() -> None:
    rng = np.random.default_rng(1)
    values = 5.0 + 0.01 * rng.normal(size=60)
    values[[3, 30]] = 9.0, 400.0
    off = centered(values)
    assert np.delete(off, [3, 30]).mean() == pytest.approx(0.0, abs=0.003)
    assert off[30] - off[3] == pytest.approx(391.0)


@pytest.mark.parametrize(
    ("gain", "std", "worst", "off", "tape", "better"),
    [
        (0.21, 0.1, 0.2, 0.0, False, True),
        (0.19, 0.1, 0.2, 0.0, False, False),  # not by two deviations
        (0.70, 9.0, 0.2, 0.0, False, True),  # but by half
        (0.69, 9.0, 0.2, 0.0, False, False),
        (0.21, 0.1, -0.019, 0.0, False, True),
        (0.21, 0.1, -0.021, 0.0, False, False),  # another sensor is worse
        (0.01, 0.1, 0.2, 8.1, False, True),  # far from the configured values
        (0.01, 0.1, 0.2, 7.9, False, False),
        (0.01, 0.1, 0.2, 8.1, True, False),  # which a person may have misread
        (-0.01, 0.1, 0.2, 8.1, False, False),
    ],
)
def test_new_values_are_written_if_they_are_surely_better(
    gain: float, std: float, worst: float, off: float, tape: bool, better: bool
) -> None:
    found = fit([sensed("gyro")], Config())
    p = np.concatenate(([0.0, 0.0, 0.01 * off], found.p[3:]))
    found = structs.replace(
        found, gain=gain, gain_std=std, worst=worst, p=p, covariance=1e-4 * np.eye(3),
        readings=Errors(1.0, 1.0) if tape else None,
    )  # fmt: skip
    assert found.better is better
    # Of independent parameters: track / mean radius, right / left, and mean radius.
    shares = structs.replace(found, gyro_std=0.0).shares
    assert shares == pytest.approx([0.01 * math.sqrt(v) for v in (1.5, 2.0, 0.5)])


def test_runs_that_hardly_move_are_no_pieces() -> None:
    t = np.arange(0.0, 9.0, 0.05)
    for angle, some in ((0.19, False), (0.21, True)):
        run = run_of("1", {"left right": (t, 0 * t, 0 * t + angle / t[-1])}, Notes())
        assert moves(run) is some
        assert bool(cut([run], 1)) is some
    long = sensed("gyro")
    (whole,) = cut([long], 1)
    assert whole.seconds == long.seconds
    assert len(cut([long], 8)) == 8
    assert len(cut([long], 40)) == 13  # of 3 s at least


@pytest.mark.parametrize(
    ("sides", "rate"), [((1.3, 1.3), 1.0), ((1.6, 1.6), 1.0), ((1.15, 1.0), 1.0), ((1, 1), 1.2)]
)
def test_halves_of_a_log_that_contradict_each_other_widen_the_deviations(
    sides: tuple[float, float], rate: float
) -> None:
    """The load, the tyres, the counts or the gyro change between two drives."""
    sound, other = (sensed("gyro", name=name, drive=LONG) for name in "ab")
    left, right, turned = sides[0] * other.left, sides[1] * other.right, rate * other.turned
    other = structs.replace(other, left=left, right=right, turned=turned, rate=rate * other.rate)
    found, before, after = (fit(runs, Config()) for runs in ([sound, other], [sound], [other]))
    track, ratio = (found.p @ row for row in ROWS)
    assert found.halves > 0.08
    for half in (before, after):
        assert half.halves == 0.0
        assert abs(half.p @ ROWS[0] - track) < 3 * found.shares[0]
        assert abs(half.p @ ROWS[1] - ratio) < 3 * found.shares[1]


LONG = motion(LEGS * 2)
ROWS = np.zeros((2, 9))
ROWS[0, [TRACK, LEFT, RIGHT]] = 1.0, -0.5, -0.5
ROWS[1, [RIGHT, LEFT]] = 1.0, -1.0


def test_halves_that_contradict_each_other_widen_by_half_of_their_difference() -> None:
    first, second = (sensed("gyro", name=name, drive=LONG) for name in "ab")
    scale = 1.3
    second = structs.replace(second, left=scale * second.left, right=scale * second.right)
    found, alone = (fit(runs, Config()) for runs in ([first, second], [first]))
    assert found.halves == pytest.approx(math.log(scale), rel=0.1)
    # The pieces scatter by as much from their mean, and there are more than twelve.
    assert len(found.pieces) >= 12
    jackknife = math.log(scale) / 2 / math.sqrt(len(found.pieces) - 1)
    wide = math.sqrt(found.shares[0] ** 2 - found.gyro_std**2)
    assert wide == pytest.approx(math.hypot(found.halves / 2, jackknife), rel=0.07)
    assert alone.shares[0] == pytest.approx(alone.gyro_std, rel=0.01)
    much = structs.replace(second, left=2 * second.left, right=2 * second.right)
    assert fit([first, much], Config()).halves == 0.6  # at most


def test_a_robot_that_never_turns_shows_no_track() -> None:
    straight = motion([(2, 0, 0), (6, 0.4, 0), (6, -0.3, 0), (6, 0.2, 0), (2, 0, 0)])
    found = fit([sensed("gyro", drive=straight)], Config())
    assert not found.tracked
    assert found.shares[0] == pytest.approx(1.0, rel=0.05)  # as before the log
    assert found.shares[1] < 0.002


def test_errors_of_turns_are_those_of_the_configured_track() -> None:
    # By the configured track, each turn is wrong by more than half a turn.
    spins = motion([(2, 0, 0), (20, 0.2, 0.8), (2, 0, 0), (20, 0.2, -0.8), (2, 0, 0)])
    for sensor in ("gyro", "headings"):
        for multiplier in (1.0, 2.0):
            config = Config(drive=DriveConfig(wheel_separation_multiplier=multiplier))
            found = fit([sensed(sensor, drive=spins)], config)
            assert found.turn
            expected = math.tau * abs(1.4925 / multiplier - 1)
            assert found.turn.now == pytest.approx(expected, rel=0.06)
            assert found.turn.new < 0.02 * math.tau
            assert found.place is None
            assert found.readings is None


def test_the_gain_is_that_of_the_errors_on_pieces_that_were_left_out() -> None:
    run = sensed("positions")
    run.place[:] += 0.02 * np.random.default_rng(3).normal(size=(2, len(run.place))).T @ [1, 1j]
    matches = {"positions": Match("positions", 0.1, 1.5, 0.0, 0.1)}
    found = fit([run], Config(), matches)
    assert found.place
    assert found.place.new == pytest.approx(0.02, rel=0.1)
    assert found.gain == pytest.approx(math.log(found.place.now / found.place.new))
    assert found.gain == found.worst
    both = fit([structs.replace(run, **gyro_of(sensed("gyro")))], Config(), matches)
    assert both.place
    by_places = math.log(both.place.now / both.place.new)
    assert both.worst == pytest.approx(min(by_places, both.gain - by_places))
    assert both.gain - by_places > 2.0  # of the gyro
    assert both.sensors == ("gyro", "positions")


def gyro_of(run: Run) -> dict[str, Floats]:
    return {"gyro_t": run.gyro_t, "rate": run.rate, "turned": run.turned}


def measured(run: Run, **readings: tuple[float, float]) -> Run:
    """Return the run without its sensors, with these readings and their deviations."""
    none = np.zeros(0)
    return structs.replace(
        run, gyro_t=none, rate=none, turned=none, place_t=none, place=none + 0j, yaw_t=none,
        yaw=none, tape=tuple(TapeReading(name, *reading) for name, reading in readings.items()),
    )  # fmt: skip


AHEAD_2_M = motion([(1, 0, 0), (5, 0.4, 0), (1, 0, 0)])
ROUND = motion([(1, 0, 0), (2 * math.pi, 0, 1.0), (1, 0, 0)])


def test_a_reading_by_tape_is_as_sure_as_it_says() -> None:
    ahead, turn = sensed("gyro", drive=AHEAD_2_M), sensed("gyro", drive=ROUND)
    for std in (0.01, 0.04):
        readings = [measured(ahead, distance=(2.02, std)), measured(turn, turn=(math.tau, 3 * std))]
        found = fit(readings, Config())
        assert found.sized
        assert found.tracked
        assert found.sensors == ("tape",)
        # Together with the 1.4 % of both wheels before.
        size = 1 / math.hypot(2.02 / std, math.sqrt(2) / 0.02)
        assert found.shares[2] == pytest.approx(size, rel=0.03)
        assert found.shares[0] == pytest.approx(3 * std / math.tau, rel=0.03)
    assert found.readings
    assert found.readings.now > 5


@pytest.mark.parametrize(
    ("sensors", "reading", "shown"),
    [
        (("gyro",), None, False),
        (("gyro",), "distance", False),
        (("gyro",), "turn", True),
        (("gyro", "headings"), None, True),
        (("headings",), None, True),
    ],
)
def test_only_another_sensor_shows_the_scale_of_a_gyro(
    sensors: tuple[str, ...], reading: str | None, shown: bool
) -> None:
    runs = [sensed(*sensors)]
    if reading:
        drive, value = (AHEAD_2_M, 2.0) if reading == "distance" else (ROUND, math.tau)
        runs.append(measured(sensed("gyro", drive=drive), **{reading: (value, 0.01)}))
    found = fit(runs, Config(odometry=OdometryConfig(gyro_scale_std=0.02)))
    assert found.gyro_std == (0.0 if shown else 0.02)
    assert (found.shares[0] >= 0.02) is not shown


def test_a_hole_in_a_gyro_is_longer_than_8_periods_and_0_3_s() -> None:
    run = sensed("gyro")
    whole = Piece(run, Base.of(Config().drive))
    p = np.zeros(9)
    steps = int(np.isfinite(whole.residuals(p)["gyro"]).sum())
    for seconds, lost in ((0.25, 0), (0.35, 0), (0.45, 1), (3.0, 4)):
        kept = ~((run.gyro_t > 20.2) & (run.gyro_t < 20.2 + seconds))
        some = structs.replace(
            run, gyro_t=run.gyro_t[kept], rate=run.rate[kept], turned=run.turned[kept]
        )
        left = np.isfinite(Piece(some, whole.base).residuals(p)["gyro"]).sum()
        assert left == steps - lost
    thin = structs.replace(run, gyro_t=run.gyro_t[::2], rate=run.rate[::2], turned=run.turned[::2])
    assert np.isfinite(Piece(thin, whole.base).residuals(p)["gyro"]).sum() == steps
    late = np.zeros(9)
    late[GYRO_DELAY] = 5.0  # whose last steps have no sample
    assert np.isfinite(whole.residuals(late)["gyro"]).sum() < steps


def test_only_a_gyro_and_headings_during_the_wheels_are_compared() -> None:
    run = sensed("headings", "positions")
    for name, sizes in (("headings", 1), ("positions", 2)):
        whole = Piece(run, Base.of(Config().drive)).residuals(np.zeros(9))[name]
        assert np.isfinite(whole).all()
        late = np.zeros(9)
        late[POSE_DELAY] = 4.05  # 21 of 5 Hz are before the wheels
        off = Piece(run, Base.of(Config().drive)).residuals(late)[name]
        assert (~np.isfinite(off)).sum() == 21 * sizes


def test_each_sensor_has_its_delay_and_a_gyro_its_scale() -> None:
    run = sensed("gyro", "positions", lever=0.1 + 0j)
    wrong = structs.replace(
        run, gyro_t=run.gyro_t + 0.8, rate=1.01 * run.rate, turned=1.01 * run.turned
    )
    matches = {
        "gyro": Match("gyro", 0.02, 1.5, 0.8, 0.02),
        "positions": Match("positions", 0.02, 1.5, 0.0, 0.02, lever=(0.1, 0.0)),
    }
    found = fit([wrong], Config(), matches)
    assert found.p[GYRO_DELAY] == pytest.approx(0.8, abs=0.01)
    assert found.p[POSE_DELAY] == pytest.approx(0.0, abs=0.01)
    assert found.p[AHEAD] == pytest.approx(0.1, abs=0.01)
    assert found.p[SCALE] == pytest.approx(-math.log(1.01), abs=0.006)
    assert multipliers(found) == pytest.approx([1.5, 1.0, 1.01], abs=0.006)


def test_a_path_is_made_of_arcs() -> None:
    half = math.pi / 2
    place, heading = path(np.array([1.0, half, half * 2]), np.array([0.0, half, -half * 2]))
    assert heading == pytest.approx([0.0, 0.0, half, -half])
    assert place == pytest.approx([0, 1, 2 + 1j, 4 + 1j])
    base = Base(0.1, 0.2, 0.5)
    distance, turn = base.motion(np.zeros(3), np.array([3.0]), np.array([4.0]))
    assert (distance[0], turn[0]) == pytest.approx((0.55, 1.0))
    wider = np.array([math.log(2), math.log(0.5), math.log(4)])
    distance, turn = base.motion(wider, np.array([3.0]), np.array([4.0]))
    assert (distance[0], turn[0]) == pytest.approx((0.5, -0.1))
