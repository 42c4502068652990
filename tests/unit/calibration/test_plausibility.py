"""Calibration refuses whole logs with a wrong sign, side or unit, and says which one is wrong.

It also requires enough movement in a log, and a fit that starts near the truth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_fit

from acsard.calibration.fit import Parameter, fit
from acsard.calibration.heading import Rows
from acsard.calibration.log_table import NoCalibrationError
from acsard.calibration.multipliers import Multipliers
from acsard.calibration.plausibility import (
    MAX_LOG_STDS,
    RATIO,
    TRACK,
    drives_enough,
    in_range,
    inaccuracy,
    remarks,
    rolls_enough,
    separates_track,
    too_inaccurate,
    turn_units,
    turns_enough,
)  # fmt: skip
from acsard.calibration.runs import Block
from tests.unit.calibration.cut import BASE, calibrated, ready, table, usual
from tests.unit.calibration.robots import GUIDED, Drive, Robot, drive

DRIVE = usual()
WRONG = {
    "gyro": replace(DRIVE, gyro=-DRIVE.gyro),
    "sides": replace(DRIVE, left=DRIVE.right, right=DRIVE.left),
    "left": replace(DRIVE, left=-DRIVE.left),
    "right": replace(DRIVE, right=-DRIVE.right),
    "ahead": replace(DRIVE, left=-DRIVE.left, right=-DRIVE.right),
    "mirror": replace(DRIVE, place=DRIVE.place.conj()),
    "degrees": replace(DRIVE, gyro=np.degrees(DRIVE.gyro)),
    "m/s": replace(DRIVE, left=DRIVE.left * 0.05, right=DRIVE.right * 0.05),
    "rpm": replace(DRIVE, left=DRIVE.left * 9.55, right=DRIVE.right * 9.55),
    "mm": replace(DRIVE, place=DRIVE.place * 1000),
    "both degrees": replace(
        DRIVE,
        gyro=np.degrees(DRIVE.gyro),
        left=np.degrees(DRIVE.left),
        right=np.degrees(DRIVE.right),
    ),
    "degrees, rpm": replace(
        DRIVE, gyro=np.degrees(DRIVE.gyro), left=DRIVE.left * 9.55, right=DRIVE.right * 9.55
    ),
    "degrees, mm/s": replace(
        DRIVE, gyro=np.degrees(DRIVE.gyro), left=DRIVE.left * 50, right=DRIVE.right * 50
    ),
    "m/s, large": replace(DRIVE, left=DRIVE.left * 0.165, right=DRIVE.right * 0.165),
    "latitude": replace(DRIVE, place=DRIVE.place * 9e-6),
    "another clock": replace(DRIVE, gyro_t=DRIVE.gyro_t + 1.7e9),
    "later": replace(DRIVE, gyro_t=DRIVE.gyro_t + 5.0),
}


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("what", "gyro", "places", "words"),
    [
        ("gyro", True, False, "positive to the left"),
        ("gyro", True, True, "yaw_rate has the wrong sign"),
        ("sides", True, False, "left and right are swapped"),
        ("sides", False, True, "left and right are swapped"),
        ("sides", True, True, "left and right are swapped"),
        ("ahead", True, True, "both sides are negative when the robot drives ahead"),
        ("left", True, False, "the left wheels turn backwards"),
        ("left", False, True, "the left wheels turn backwards"),
        ("right", True, False, "the right wheels turn backwards"),
        ("right", False, True, "the right wheels turn backwards"),
        ("mirror", True, True, "y is positive to the right"),
        ("mirror", False, True, "y is positive to the right"),
        ("degrees", True, False, "yaw_rate seems to be in degrees"),
        ("m/s", True, False, "wheel speeds are in m/s"),
        ("m/s", False, True, "wheel speeds are in m/s"),
        ("rpm", True, False, "rpm"),
        ("rpm", False, True, "rpm"),
        ("mm", False, True, "mm or cm"),
        ("both degrees", True, False, "yaw_rate seems to be in degrees"),
        ("degrees, rpm", True, False, "yaw_rate seems to be in degrees"),
        ("degrees, mm/s", True, False, "yaw_rate seems to be in degrees"),
        ("m/s, large", True, False, "wheel speeds are in m/s"),
        ("latitude", False, True, "latitude and longitude"),
        ("another clock", True, False, "times from the same clock"),
        ("another clock", True, True, "times from the same clock"),
        ("later", True, False, "does not follow the wheels"),
    ],
)
def test_a_wrong_sign_unit_or_clock_is_refused_by_name(
    what: str, gyro: bool, places: bool, words: str
) -> None:
    with pytest.raises(NoCalibrationError) as refused:
        calibrated(table(WRONG[what], gyro=gyro, places=places))
    assert words in str(refused.value)


def test_rpm_are_refused_also_with_the_configuration_of_another_robot() -> None:
    """The configured robot has larger wheels for its separation than the default robot."""
    with pytest.raises(NoCalibrationError, match="rpm"):
        turn_units("yaw_rate", 1.9 * 2 * np.pi / 60, 1.9 * 2 * np.pi / 60, BASE)
    turn_units("yaw_rate", 1 / 3.5, 1 / 3.5, BASE)


def odometry(robot: Drive) -> Drive:
    """Return a log whose positions and turn rate are the wheel odometry of the robot's driver."""
    turn = (robot.right - robot.left) * 0.05 / 0.45
    yaw = np.cumsum(turn) * 0.01
    ahead = np.exp(1j * (yaw - turn * 0.005))
    way = np.asarray(np.cumsum((robot.left + robot.right) / 2 * 0.05 * ahead), np.complex128)
    return replace(
        robot, gyro_t=robot.t, gyro=turn, place_t=robot.t[::10], place=way[::10] * 0.01
    )  # fmt: skip


@pytest.mark.variations(2)
@pytest.mark.parametrize(("gyro", "places"), [(True, False), (False, True)])
def test_a_reference_computed_from_the_same_wheels_is_reported(gyro: bool, places: bool) -> None:
    log = table(odometry(DRIVE), gyro=gyro, places=places)
    assert any("computed from the same wheels" in note for note in calibrated(log).notes)
    usual_log = table(DRIVE, gyro=gyro, places=places)
    assert not any("same wheels" in note for note in calibrated(usual_log).notes)


def test_an_imu_that_lies_on_its_side_is_refused() -> None:
    """The wrong axis measures only noise, although the robot turned several times."""
    rng = np.random.default_rng(0)
    lying = replace(DRIVE, gyro=rng.normal(0.0, 0.05, len(DRIVE.gyro)))
    with pytest.raises(
        NoCalibrationError, match=r"but the wheels would turn.*IMU lies on its side"
    ):
        calibrated(table(lying, places=False))


def test_positions_alone_are_not_called_a_yaw_in_degrees() -> None:
    with pytest.raises(NoCalibrationError) as refused:
        turn_units("", 10.0, 10.0, BASE)
    assert "degrees" not in str(refused.value)
    assert "yaw" not in str(refused.value)


def test_motion_capture_on_a_good_floor_is_not_taken_for_wheel_odometry() -> None:
    """Motion capture and the wheels of a robot that hardly slips differ by a millimetre."""
    robot = Robot(
        chi=1.0, rate=0.0, slip=0.0005, place_noise=0.0005, outliers=0.0, place_hz=20.0,
        rng=np.random.default_rng(1),
    )  # fmt: skip
    notes = calibrated(table(drive(robot, GUIDED), gyro=False)).notes
    assert not any("same wheels" in note for note in notes)


@pytest.mark.slow
def test_positions_of_another_drive_are_refused() -> None:
    x, y = np.random.default_rng(1).normal(size=(2, len(DRIVE.place)))
    still = replace(DRIVE, place=x + 1j * y)
    with pytest.raises(NoCalibrationError, match="positions"):
        calibrated(table(still, gyro=False))


def test_multipliers_outside_of_the_configurable_range_are_refused() -> None:
    in_range(np.array([2.51, 1.0, 1.0]))
    with pytest.raises(NoCalibrationError, match=r"from 0\.1 to 10"):
        in_range(np.array([12.0, 1.0, 1.0]))


def test_unusual_values_are_reported() -> None:
    notes = list(
        remarks({"yaw_rate": 0.6}, 0.2, np.ones(5), np.array([5.0, 2, 2]), BASE, sized=True)
    )
    assert len(notes) == 5
    assert not list(
        remarks({"x": 0.001}, 0.0, np.array([1.0, -1]), np.array([1.6, 1, 1]), BASE, sized=True)
    )


def test_sides_of_different_size_are_reported() -> None:
    turned = np.array([1.0, -1.0])
    notes = list(remarks({}, 0.0, turned, np.array([1.6, 0.75, 1.5]), BASE, sized=False))
    assert [text for text in notes if "the right wheels are 2 times as large" in text] == notes
    assert len(notes) == 1
    assert not list(remarks({}, 0.0, turned, np.array([1.6, 0.96, 1.04]), BASE, sized=True))


@pytest.mark.variations(3)
@pytest.mark.parametrize(("gyro", "places"), [(True, False), (False, True), (True, True)])
def test_the_starting_point_is_near_the_truth(gyro: bool, places: bool) -> None:
    made = ready(table(usual(), gyro=gyro, places=places))
    assert len(made.sources) == gyro + places
    assert made.start[[Parameter.LEFT, Parameter.RIGHT]] == pytest.approx([1.0, 1.0], abs=0.05)
    assert 1 / made.start[Parameter.INVERSE_TRACK] == pytest.approx(1.66, abs=0.15)


def test_positions_from_another_time_are_refused() -> None:
    drive = usual()
    other = replace(drive, place_t=drive.place_t + 1000.0, gyro=np.zeros(0), gyro_t=np.zeros(0))
    with pytest.raises(NoCalibrationError, match="same clock"):
        ready(table(other, gyro=False))


def rows(left: list[float], right: list[float]) -> Rows:
    unit = np.ones(len(left))
    return Rows(unit.astype(np.int64), unit, np.array(left), np.array(right), unit, unit)


def test_turns_and_straight_drives_are_enough() -> None:
    rolls_enough(rows([9, -9, 9, -9], [9, -9, -9, 9]))
    turns_enough(np.full(10, 1.0))
    drives_enough([Block(0, 0, 4)] * 5)
    assert not too_inaccurate({TRACK: 0.01, RATIO: 0.0045}, MAX_LOG_STDS)


@pytest.mark.parametrize(
    ("left", "right"),
    [([9, 9, 9], [9, 9, 9]), ([9, -9, 9], [-9, 9, -9]), ([5, 5, 5], [15, 15, 15])],
)
def test_a_log_of_only_one_movement_is_refused_with_a_drive_to_make(
    left: list[float], right: list[float]
) -> None:
    with pytest.raises(NoCalibrationError) as refused:
        rolls_enough(rows(left, right))
    assert "a drive of 60 s" in str(refused.value)


def test_too_little_turning_or_driving_is_refused() -> None:
    with pytest.raises(NoCalibrationError, match="57 deg"):
        turns_enough(np.array([0.5, -0.5]))
    with pytest.raises(NoCalibrationError, match="only 8 s"):
        drives_enough([Block(0, 0, 4)] * 2)


def test_turns_on_the_spot_are_enough_for_a_heading_sensor() -> None:
    spins = rows([-9, 9, -9], [9, -9, 9])
    rolls_enough(spins, spins=True)
    with pytest.raises(NoCalibrationError, match="ahead or back"):
        rolls_enough(spins)


def test_turns_on_the_spot_are_enough_if_one_side_always_rolls_a_little_further() -> None:
    rolls_enough(rows([-8.91, 8.91, -8.91], [9, -9, 9]), spins=True)
    with pytest.raises(NoCalibrationError, match="in opposite directions"):
        rolls_enough(rows([0.1, -0.1], [0.1, -0.1]), spins=True)


def test_an_uncertain_parameter_is_named_with_its_deviation() -> None:
    apart = Multipliers(np.array([1.6, 1, 1]), np.diag([0, 1e-3, 1e-3]))
    ratio = apart.relative_deviations().ratio
    assert ratio == pytest.approx(0.0447, abs=1e-4)
    assert too_inaccurate({TRACK: 0.01, RATIO: ratio}, MAX_LOG_STDS) == {RATIO: ratio}
    assert TRACK in too_inaccurate({TRACK: np.nan, RATIO: 0.001}, MAX_LOG_STDS)


def test_the_text_names_the_deviation_and_its_limit_or_says_that_there_is_no_value() -> None:
    sentence = inaccuracy({RATIO: 0.05, TRACK: np.inf}, MAX_LOG_STDS)
    assert sentence.startswith(
        "this log is too inaccurate: the standard deviation of the ratio of the right to the left "
        "wheel radius is 5.0%, but at most 3% is accepted, and the effective track cannot be "
        "determined: record a drive of 60 s"
    )


def test_equal_columns_of_the_fit_do_not_separate_the_track() -> None:
    made = ready(table(usual(), places=False))
    fitted = fit(made.sources, made.start, places=False)
    assert separates_track(fitted)
    alike = np.zeros_like(fitted.normal)
    alike[:, :3, :3] = 1.0
    assert not separates_track(replace_fit(fitted, normal=alike))
