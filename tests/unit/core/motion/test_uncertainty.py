"""NEES of the published covariance over many robots whose wheels have the configured errors.

If the true mean is 3, the mean of 1000 runs is within 2.85 to 3.15 nineteen times in twenty. The
tests use fixed seeds. `-m soak -s` prints all figures.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.error_model import ErrorModel
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.odometry import Odometry
from acsard.core.motion.uncertainty import PoseUncertainty
from acsard.core.values import STILL, WheelSpeeds
from tests.unit.core.link.counted import RADIUS, TRACK
from tests.unit.core.motion.nees import (
    AT,
    DEFAULT,
    PERIOD,
    REGION,
    SCENARIOS,
    WHEELS,
    Array,
    Heard,
    Legs,
    Model,
    Scenario,
    fold,
    nees,
    plain,
    random,
    reports,
    study,
    true_ends,
)

CALIBRATED = {"radius_std": 0.002, "track_std": 0.01}
MODELS = {
    "wheels": WHEELS,
    "default": DEFAULT,
    "wheels, parameters": replace(WHEELS, **CALIBRATED),
    "default, parameters": replace(DEFAULT, **CALIBRATED),
}

FAR = {"straight", "there and back"}
"""Scenarios in which the error along the path depends only on the square of the heading error.

No Gaussian has both its variance and its tails. The published variance is right.
"""


def check(values: Array, name: str, low: float = 0.93, spare: float = 0.0) -> None:
    inside = float((values < REGION).mean())
    print(f"{name}: NEES {values.mean():.2f}, 95 % region holds {100 * inside:.1f} %")
    assert 2.85 - spare < values.mean() < 3.15 + spare
    assert low - spare / 10 <= inside <= 0.97 + spare / 10


@pytest.mark.soak
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_covariance_matches_the_pose_errors(scenario: str, model: str) -> None:
    drives = 50 if scenario == "random" else 1
    chosen = MODELS[model]
    if scenario == "straight" and chosen.radius_std:
        # An error of 0.2 % in each radius gives 0.57 rad at the end of 60 m. To fourth order that
        # is NEES 3.2.
        chosen = replace(chosen, radius_std=0.001)
    values = study(SCENARIOS[scenario], chosen, runs=4000, drives=drives)
    check(values, f"{scenario}, {model}", 0.905 if scenario in FAR else 0.93)


def lap(_: np.random.Generator) -> Legs:
    return [(0.8, 0.6, 10.0)]


def corner(_: np.random.Generator) -> Legs:
    return [(0.8, 0.0, 5.0), (0.0, 1.2, 1.3), (0.8, 0.0, 5.0)]


@pytest.mark.variations(2)
@pytest.mark.parametrize("model", ["default", "wheels, parameters"])
@pytest.mark.parametrize("legs", [lap, corner])
def test_the_covariance_of_a_short_drive_matches_the_pose_errors(
    legs: Scenario, model: str
) -> None:
    check(study(legs, MODELS[model], runs=1500), f"{legs.__name__}, {model}", spare=0.05)


# bursts of lost lines


def bursts(a_minute: float) -> Heard:
    """Return a function that removes bursts of 0.1 to 0.5 s of lines, this many a minute.

    It fills them with values between the neighbouring lines.
    """

    def lines_of(drive: Array, rng: np.random.Generator) -> list[Feedback]:
        lost, at = np.zeros(len(drive), dtype=bool), 0
        while (at := at + 10 + int(rng.exponential(6000 / a_minute))) < len(drive) - 60:
            length = int(rng.uniform(10, 50))
            lost[at : at + length] = True
            at += length
        lines = np.arange(len(drive))
        samples = drive.copy()
        for side in samples.T:
            side[lost] = np.interp(lines[lost], lines[~lost], side[~lost])
        return [
            Feedback(AT, WheelSpeeds(r, le, le, r), PERIOD, bridged=PERIOD * bool(missing))
            for (le, r), missing in zip(samples.tolist(), lost, strict=True)
        ]

    return lines_of


@pytest.mark.soak
@pytest.mark.parametrize("model", MODELS)
def test_the_covariance_matches_the_pose_errors_after_bridged_bursts(model: str) -> None:
    values = study(random, MODELS[model], runs=1000, drives=100, heard=bursts(2.0))
    check(values, f"bursts, {model}")


@pytest.mark.slow
def test_the_covariance_matches_the_pose_errors_after_fifty_gaps_at_cruise() -> None:
    """The drive has 50 gaps of 150 ms in which the pose does not move."""
    rng = np.random.default_rng(5)
    drive = reports([(0.5, 0.02, 60.0)])
    lines, at = [], 0
    for start in range(100, 5900, 116):
        lines += plain(drive[at:start])
        after = drive[start + 14]
        speeds = WheelSpeeds(after[1], after[0], after[0], after[1])
        lines.append(Feedback(AT, speeds, 0.0, gap=0.15))
        at = start + 15
    lines += plain(drive[at:])
    ends = true_ends([drive], 500, DEFAULT, rng)
    values = nees(*fold(lines, DEFAULT), ends[:, 0])
    inside = float((values < REGION).mean())
    print(f"50 gaps: NEES {values.mean():.2f}, 95 % region holds {100 * inside:.1f} %")
    assert 2.75 < values.mean() < 3.25
    assert 0.92 < inside < 0.98


# encoders


def counting(counts: int) -> Heard:
    """Return a function that makes lines with the whole counts of wheel counters.

    Each counter starts at a random fraction of a count.
    """

    def lines_of(drive: Array, rng: np.random.Generator) -> list[Feedback]:
        wheels = drive[:, [1, 0, 0, 1]] * PERIOD / math.tau * counts
        counted = np.floor(np.cumsum(wheels, axis=0) + rng.random(4))
        turned = np.diff(counted, axis=0, prepend=counted[:1]) * math.tau / counts
        rows = zip(drive.tolist(), turned.tolist(), strict=True)
        return [
            Feedback(AT, WheelSpeeds(r, le, le, r), PERIOD, turned=tuple(row))
            for (le, r), row in rows
        ]

    return lines_of


DRIVES = SCENARIOS | {"minute": lambda rng: random(rng, 60.0)}


@pytest.mark.soak
@pytest.mark.parametrize("counts", [20, 96, 400, 3200])
@pytest.mark.parametrize("scenario", ["square", "minute", "circle"])
def test_the_covariance_matches_the_pose_errors_of_coarse_encoders(
    scenario: str, counts: int
) -> None:
    values = study(
        DRIVES[scenario], DEFAULT, 1000, drives=40, heard=counting(counts), counts=counts
    )
    check(values, f"{scenario}, {counts} counts")


@pytest.mark.parametrize("counts", [400, 3200])
def test_the_encoder_counts_of_a_straight_add_no_yaw_variance(counts: int) -> None:
    rng = np.random.default_rng(1)
    drive = reports([(0.5, 0.0, 20.0)])
    _, by_counts = fold(counting(counts)(drive, rng), DEFAULT, counts)
    _, exact = fold(plain(drive), DEFAULT)
    assert by_counts[2, 2] == pytest.approx(exact[2, 2], rel=0.05)


# the parts


def uncertainty(model: Model = DEFAULT, **changes: float) -> PoseUncertainty:
    config = replace(model.config(), **changes)
    return PoseUncertainty(ErrorModel(config, Kinematics(DriveConfig())), 0)


def test_the_deviation_of_a_wheel_radius_makes_the_pose_less_certain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("acsard.core.motion.uncertainty.START_VARIANCE", 0.0)
    # After 10 m straight with the right wheels' radius off by 0.2 %, 0.01 m of length and 20 mm /
    # 0.3 m of yaw are wrong.
    odometry = OdometryConfig(
        distance_variance_per_metre=0.0,
        yaw_variance_per_metre=0.0,
        yaw_variance_per_radian=0.0,
        right_wheel_radius_multiplier_std=0.002,
    )
    model = PoseUncertainty(ErrorModel(odometry, Kinematics(DriveConfig())), 0)
    for _ in range(1000):
        model.advance(0.01, 0.0, 0.01, 0.0, 0.0)
    p = model.covariance
    assert math.sqrt(p.yawyaw) == pytest.approx(0.02 / 0.3)
    assert math.sqrt(p.yy) == pytest.approx(0.02 / 0.3 * 10.0 / 2, rel=1e-3)
    # The length is off by 0.01 m. A circle of 1/15 rad differs from its chord by 10 m x yaw2 / 12:
    # sqrt(3) x 3.7 mm.
    bent = 10.0 * (0.02 / 0.3) ** 2 / 12
    assert math.sqrt(p.xx) == pytest.approx(math.hypot(0.01, math.sqrt(3) * bent), rel=1e-2)


def test_the_yaw_error_of_a_wheel_radius_cancels_on_the_way_back() -> None:
    first = uncertainty(left_wheel_radius_multiplier_std=0.01)
    for step in [0.01] * 500 + [-0.01] * 500:
        first.advance(step, 0.0, step, 0.0, 0.0)
    second = uncertainty()
    for step in [0.01] * 500 + [-0.01] * 500:
        second.advance(step, 0.0, step, 0.0, 0.0)
    assert first.covariance.yawyaw == pytest.approx(second.covariance.yawyaw)


@pytest.mark.slow
def test_a_heading_error_that_comes_and_goes_shortens_a_straight() -> None:
    # 60 m at k = 1e-5 gives q = 2 k / L2 of yaw per metre. The area between path and chord has the
    # variance q2 s4 / 48.
    drive = reports([(1.0, 0.0, 60.5), (0.0, 0.0, 1.0)])
    length = float(drive.mean(axis=1).sum()) * 0.05 * PERIOD
    q = WHEELS.yaw
    _, p = fold(plain(drive), WHEELS)
    expected = 1e-6 + WHEELS.distance * length + q**2 * length**4 / 48
    assert p[0, 0] == pytest.approx(expected, rel=0.03)
    assert p[0, 0] > 30 * WHEELS.distance * length


@pytest.mark.parametrize("turns", [1.0, -1.0])
def test_turning_to_and_fro_counts_both_ways(turns: float) -> None:
    model = uncertainty()
    for turn in [0.01 * turns] * 100 + [-0.01 * turns] * 100:
        model.advance(0.0, turn, 0.0, 0.0, 0.0)
    # The robot turns by 2 rad, less the play at the start and twice that at the reversal.
    assert model.covariance.yawyaw == pytest.approx(2e-2, rel=0.01)


def test_trembling_within_a_count_is_no_turning() -> None:
    model = uncertainty()
    start = model.covariance.yawyaw
    for _ in range(10_000):
        model.advance(0.0, 0.001, 0.0, 0.0, 0.0)
        model.advance(0.0, -0.001, 0.0, 0.0, 0.0)
    # The wheels' path of 2 x 1000 m counts as such: 1.5e-5 per radian.
    assert model.covariance.yawyaw - start < 1e-1 * 20.0 * 1e-2


@pytest.mark.parametrize("counts", [16, 96, 400])
def test_the_unknown_wheel_angle_within_a_count_adds_to_the_yaw_variance(
    counts: int,
) -> None:
    kinematics, count = Kinematics(DriveConfig()), RADIUS * math.tau / counts
    known, unknown = (
        Odometry(OdometryConfig(), kinematics, setting).fold(Feedback(AT, STILL, 0.01)).covariance
        for setting in (counts, 0)
    )
    places = 2 * count**2 / 24 * 2 / TRACK**2
    assert known.yawyaw - unknown.yawyaw == pytest.approx(places), "at the start, and now"


def test_the_yaw_errors_of_the_gyro_and_of_gaps_are_separate_whichever_came_first() -> None:
    gaps_first, gyro_first = uncertainty(), uncertainty()
    before = gyro_first.covariance.yawyaw
    gaps_first.add_gap(0.0, 0.0, 0.0, 0.0)
    for model in (gaps_first, gyro_first):
        model.advance(0.0, 10.0, 0.0, 0.0, 0.0, variance=0.0)
        model.add_gap(0.0, 0.2, 0.0, 0.0)
        model.advance(0.0, 10.0, 0.0, 0.0, 0.0, variance=0.0)
        model.add_gap(0.0, -0.2, 0.0, 0.0)
    of_skidding = 0.4 * DEFAULT.skid
    for model in (gaps_first, gyro_first):
        grown = model.covariance.yawyaw - before
        assert grown == pytest.approx(
            (20.0 * OdometryConfig().gyro_scale_std) ** 2 + of_skidding, rel=0.01
        )


def test_a_turn_that_the_wheels_give_has_no_error_of_the_gyro_scale() -> None:
    gyro_model, plain_model = uncertainty(), uncertainty()
    gyro_model.advance(0.0, 0.0, 0.0, 0.0, 0.0, variance=0.0)
    for each in (gyro_model, plain_model):
        each.advance(0.0, 10.0, 0.0, 0.0, 0.0)
    assert gyro_model.covariance == plain_model.covariance
