"""Tests of the steps, speeds and distances of a guided calibration."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.guided.drive_plan import (
    MAX_ROLLING_SPEED,
    USUAL_SPEED,
    GuideError,
    Leg,
    Move,
    setup,
)
from acsard.calibration.guided.methods import METHODS
from acsard.core.config.settings import Config, DriveConfig, LimitsConfig
from tests.unit.calibration.guided.room import beyond

SPIN = st.floats(-5.0, 5.0).filter(lambda rate: abs(rate) > 0.1)


def robot(
    separation: float = 0.3, multiplier: float = 1.0, limits: LimitsConfig | None = None
) -> Config:
    drive = DriveConfig(wheel_separation=separation, wheel_separation_multiplier=multiplier)
    return Config(drive=drive, limits=limits or LimitsConfig())


@given(
    rate=SPIN,
    separation=st.floats(0.1, 0.8),
    multiplier=st.floats(0.5, 2.5),
    linear=st.floats(0.06, 2.0),
    angular=st.floats(0.3, 10.0),
    wheel=st.floats(3.0, 60.0),
)
def test_no_command_exceeds_the_limits_or_the_slow_speed_of_the_plan(
    rate: float, separation: float, multiplier: float, linear: float, angular: float, wheel: float
) -> None:
    limits = LimitsConfig(linear_speed=linear, angular_speed=angular, wheel_speed=wheel)
    made = setup(robot(separation, multiplier, limits))
    ahead, spin = made.ahead(1.0), made.spin(rate, 1.0)
    assert ahead.linear <= min(USUAL_SPEED, linear) + 1e-12
    assert abs(spin.angular) <= angular * (1 + 1e-12)
    rolls = abs(spin.angular) * multiplier * separation / 2
    assert rolls <= min(MAX_ROLLING_SPEED, wheel * 0.05) * (1 + 1e-12)
    assert ahead.linear <= wheel * 0.05
    assert math.copysign(1, spin.angular) == math.copysign(1, rate)


RADIUS = st.floats(0.8, 1.3)


@given(
    angle=SPIN, track=st.floats(1.0, 2.5), multiplier=st.floats(0.5, 2.5), left=RADIUS, right=RADIUS
)
def test_a_turn_planned_with_the_true_track_has_its_angle_whatever_is_configured(
    angle: float, track: float, multiplier: float, left: float, right: float
) -> None:
    config = robot(multiplier=multiplier)
    drive = msgspec.structs.replace(
        config.drive, left_wheel_radius_multiplier=left, right_wheel_radius_multiplier=right
    )
    move = setup(msgspec.structs.replace(config, drive=drive)).turn(angle, 0.9, track)
    # The daemon divides the speed of each side's rim by the radius multiplier of that side.
    rim = move.angular * multiplier * drive.wheel_separation / 2
    turn_rate = (rim / right + rim / left) / (track * drive.wheel_separation)
    assert turn_rate * move.seconds == pytest.approx(angle)


@pytest.mark.parametrize("way", METHODS)
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.6])
@pytest.mark.parametrize("multiplier", [1.0, 1.6])
def test_every_point_of_the_robot_stays_in_the_room(
    way: str, separation: float, multiplier: float
) -> None:
    """Drive each method with many true tracks, each measured with an error of 3 %."""
    made = setup(robot(separation, multiplier))
    for track in (1.0, 1.4, 1.9, 2.5):
        for off, bend in ((0.97, 0.01), (1.03, -0.01)):
            assert beyond(way, made, track, min(2.5, track * off), bend) <= 1e-6, (track, off)


def test_a_plan_too_long_for_the_room_is_found_to_leave_the_room() -> None:
    made = msgspec.structs.replace(setup(Config()), length=2.6)
    assert beyond("gyro", made, 1.0, 1.0, 0.0) > 0.05


def test_a_robot_too_large_for_the_room_is_refused_with_the_option_log() -> None:
    with pytest.raises(GuideError, match="--log"):
        setup(robot(1.4))


@pytest.mark.parametrize(
    "limits", [LimitsConfig(linear_speed=0.01), LimitsConfig(angular_speed=0.1)]
)
def test_limits_that_are_too_low_are_named(limits: LimitsConfig) -> None:
    with pytest.raises(GuideError, match="limits"):
        setup(robot(limits=limits))


def test_the_straight_drive_ends_short_however_weak_the_brakes() -> None:
    made = setup(robot(limits=LimitsConfig(linear_deceleration=0.05)))
    assert made.speed**2 / (2 * 0.05) <= 0.1 + 1e-9


def test_a_leg_lasts_as_long_as_its_moves() -> None:
    assert Leg("", "", (Move(1.5), Move(2.0, 0.3))).seconds == 3.5
