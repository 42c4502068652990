"""The sentences and settings of a result follow from the log, on logs of 40 s."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration.log import Log, LogError, Notes, Run, read, run_of
from acsard.calibration.result import Result, _require_motion, calibrate, text
from acsard.core.config.settings import Config, DriveConfig, OdometryConfig
from tests.unit.calibration_robots import GUIDED, Robot
from tests.unit.calibration_robots import drive as driven
from tests.unit.planted_logs import log as planted_log
from tests.unit.planted_logs import outcome
from tests.unit.test_calibration_matches import DRIVE, RIGHT, TRACK, log


def calibrated(*runs: Run, config: Config | None = None, notes: Sequence[str] = ()) -> Result:
    return calibrate(Log(runs, tuple(notes)), config or Config(), "a.csv")


def refused(*runs: Run, config: Config | None = None) -> str:
    with pytest.raises(LogError) as error:
        calibrated(*runs, config=config)
    return str(error.value)


def drive(**other: float) -> Config:
    return Config(drive=DriveConfig(**other))


@pytest.fixture(scope="module")
def by_gyro() -> Result:
    return calibrated(log("gyro"), notes=["a note"])


@pytest.fixture(scope="module")
def by_positions() -> Result:
    return calibrated(log("positions"))


def test_a_gyro_gives_track_and_ratio_but_not_the_size(by_gyro: Result) -> None:
    track, left, right = by_gyro.found.values()
    assert track == pytest.approx(TRACK, rel=0.01)
    assert right / left == pytest.approx(RIGHT, rel=0.002)
    assert math.sqrt(left * right) == pytest.approx(1.0, abs=0.001)
    # What the log does not show stays as sure as it was: the gyro's scale, and the size.
    stds = by_gyro.deviations
    assert stds["wheel_separation_multiplier"] == pytest.approx(0.03 * TRACK, rel=0.1)
    assert stds["left_wheel_radius_multiplier"] == pytest.approx(0.014, abs=0.002)
    track_std = by_gyro.settings["odometry.wheel_separation_multiplier_std"]
    assert track_std == pytest.approx(stds["wheel_separation_multiplier"], rel=0.01)
    assert by_gyro.settings["odometry.distance_scale_std"] == pytest.approx(0.014, abs=0.002)
    assert "drive.wheel_radius: measure a straight run with a tape" in by_gyro.decisions[1]
    assert "odometry.distance_variance_per_metre" not in by_gyro.settings
    assert by_gyro.reference == "gyro"
    assert by_gyro.notes == ("a note",)
    assert by_gyro.seconds == pytest.approx(DRIVE["t"][-1], abs=0.1)
    assert by_gyro.distance == pytest.approx(7.49, abs=0.05)
    assert by_gyro.turns == pytest.approx(2.98, abs=0.05)
    assert by_gyro.turn_error
    assert by_gyro.turn_error.new < 2.0
    assert by_gyro.turn_error.now == pytest.approx(360 * (TRACK - 1), rel=0.05)


def test_positions_give_the_size_too(by_positions: Result) -> None:
    assert list(by_positions.found.values()) == pytest.approx([1.5, 1.0, RIGHT], abs=0.01)
    assert by_positions.deviations["left_wheel_radius_multiplier"] < 0.01
    assert by_positions.settings["odometry.distance_scale_std"] < 0.01
    words = " ".join(by_positions.decisions)
    assert "The drives show the size of the wheels: distances are right to 0." in words
    assert "positions err by" in words
    error = by_positions.position_error
    assert error
    assert error.new < 0.003 < 0.008 < error.now


def test_the_factors_are_those_of_the_configured_ones(by_gyro: Result) -> None:
    config = drive(wheel_separation_multiplier=1.2, left_wheel_radius_multiplier=0.98)
    other = calibrated(log("gyro"), config=config)
    for name, value in by_gyro.found.items():
        ratio = 0.98 if "radius" in name else 1.0  # the mean radius stays
        assert other.found[name] == pytest.approx(value * ratio**0.5, rel=0.012)
    for name in by_gyro.deviations:
        assert other.deviations[name] == pytest.approx(by_gyro.deviations[name], rel=0.1)


def test_a_configuration_that_a_log_confirms_agrees(by_gyro: Result) -> None:
    words = refused(log("gyro"), config=drive(**by_gyro.found))
    assert words.startswith("Your robot agrees with its configuration: nothing to write.")
    assert "Track and radii stay as configured" in words


def test_the_text_has_the_values_and_the_notes(by_gyro: Result) -> None:
    head, _, _, _, *rest = text(by_gyro, Config(), "acsard.toml")
    assert isinstance(head, str)
    assert head.startswith("a.csv: 1 run, 40 s, 7.5 m, 3.0 turns, compared with gyro")
    assert "settings for acsard.toml (--write writes them):" in rest
    assert rest[-1] == "note: a note"
    written = list(text(structs.replace(by_gyro, written="x", notes=()), Config(), "acsard.toml"))
    assert "acsard.toml: written" in written
    assert written[-1] != ""


def test_numbers_have_two_digits(by_gyro: Result) -> None:
    assert "instead of 177 deg" in by_gyro.decisions[0] or "instead of 17" in by_gyro.decisions[0]
    assert by_gyro.turn_error
    assert f"errs by {by_gyro.turn_error.new:.2f} deg" in by_gyro.decisions[0]


def test_wheels_must_roll_20_rad() -> None:
    run = log("gyro")
    few = 39.0 / float(np.abs(np.diff(run.left)).sum() + np.abs(np.diff(run.right)).sum())
    words = refused(structs.replace(run, left=few * run.left, right=few * run.right))
    assert words.startswith("the wheels roll only 19.5 rad in this log")
    more = 41 / 39 * few
    words = refused(structs.replace(run, left=more * run.left, right=more * run.right))
    assert "roll only" not in words


def stretched(run: Run, factor: float) -> Run:
    """Return the run with another unit of t, so that integrals grow alike."""
    return run_of("1", {
        "left right": (factor * run.t, np.gradient(run.left, run.t), np.gradient(run.right, run.t)),
        "yaw_rate": (factor * run.gyro_t, run.rate),
    }, Notes())  # fmt: skip


def test_a_drive_that_no_robot_makes_is_refused() -> None:
    run = log("gyro")
    large = drive(wheel_radius=5.0, wheel_separation=30.0)
    assert "which no robot does in a calibration: is t in s" in refused(run, config=large)
    assert calibrated(run, config=drive(wheel_radius=1.0, wheel_separation=6.0)).better
    # The wheels of a log of 4,000 s never change their speed within 1 s.
    words = refused(stretched(log("gyro", step=0.01), 100.0))
    assert words.startswith("in 3999 s, no wheel changes by more than ")
    assert "is t in s, and not in 1/100 s or ms?" in words
    assert calibrated(stretched(run, 20.0)).better  # a robot that starts slowly


@pytest.mark.slow
def test_a_robot_that_stands_for_nearly_all_of_a_log_is_calibrated() -> None:
    rows = driven(Robot(rng=np.random.default_rng(3)), [(1700.0, 0.0, 0.0), *GUIDED])
    assert calibrate(read(rows.csv(places=False).encode()), Config(), "a.csv").better


def test_sensors_of_two_robots_contradict_each_other() -> None:
    run = log("gyro", "positions")
    assert calibrated(run).better
    other = structs.replace(run, rate=0.8 * run.rate, turned=0.8 * run.turned)
    words = refused(other)
    assert words.startswith("yaw_rate and x, y contradict each other: the track is 1.8")
    assert "by yaw_rate and 1." in words
    assert words.endswith("Leave the column of the wrong sensor out")


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.98, 1.02])
def test_a_sound_sensor_that_confirms_the_configuration_is_not_left_out(scale: float) -> None:
    """The gyro's scale is wrong by less than its share."""
    sound = Robot(
        chi=1.5, rate=0.0, left=1.0, right=1.0, place_noise=0.004, outliers=0.02,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    rows = driven(sound, GUIDED)
    rows.gyro *= scale
    right = drive(wheel_separation_multiplier=1.5)
    with pytest.raises(LogError, match="nothing to write"):
        calibrate(read(rows.csv().encode()), right, "a.csv")


@pytest.mark.slow
def test_a_side_that_is_dead_for_half_of_a_log_is_named_although_positions_fit_roughly() -> None:
    fault = "dead from half"
    assert outcome(planted_log(fault, "positions", 9300), 9300, fault) == "named"


def test_a_sensor_with_too_few_values_is_left_out_with_a_note() -> None:
    run = log("gyro", "positions")
    few = structs.replace(run, place_t=run.place_t[::40], place=run.place[::40])
    result = calibrated(few)
    assert result.reference == "gyro"
    assert any("x, y is left out, because it has too few values" in n for n in result.notes)


def test_a_sensor_that_is_exact_was_computed_from_the_wheels() -> None:
    run = log("gyro")
    w = 0.05 * (np.gradient(run.right, run.t) - np.gradient(run.left, run.t)) / 0.45
    rows = (run.t, np.gradient(run.left, run.t), np.gradient(run.right, run.t))
    copied = run_of("1", {"left right": rows, "yaw_rate": (run.t, w)}, Notes())
    assert "yaw_rate agrees with the wheels better than a sensor can" in calibrated(copied).notes[0]
    assert OdometryConfig().gyro_scale_std == 0.03  # of which the deviations above are made


@pytest.mark.parametrize(
    ("seconds", "fastest", "change", "robot"),
    [
        (1100.0, 2.0, 0.44, True),  # by 20 % of the usual speed within 1 s
        (1100.0, 2.0, 0.36, False),
        (1100.0, 20.0, 2.1, True),  # or by a tenth of the configured acceleration
        (1100.0, 20.0, 1.9, False),
        (990.0, 2.0, 0.36, True),
        (1010.0, 2.0, 0.36, False),
    ],
)
def test_the_wheels_of_a_long_log_change_their_speed_as_robots_do(
    seconds: float, fastest: float, change: float, robot: bool
) -> None:
    t = np.arange(0.0, seconds, 0.5)
    angle = fastest * fastest / change * np.sin(t * change / fastest)
    still = np.zeros(len(t))
    run = structs.replace(log("gyro"), t=t, left=angle, right=still + t)
    with nullcontext() if robot else pytest.raises(LogError, match="no wheel changes by more than"):
        _require_motion([run], Config())
