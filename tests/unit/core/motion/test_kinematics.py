"""Tests of the conversion between twist and wheel speeds by equations (1) to (3).

They also test saturation, which lowers all wheel speeds and keeps the curvature.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import REST, STILL, Twist, WheelSpeeds
from tests.each import each
from tests.vectors.drive import CALIBRATED, TWIST_OF_WHEELS, WHEELS_OF_TWIST

Pair = tuple[float, float]

factors = st.floats(0.1, 10.0)
robots = st.builds(
    DriveConfig,
    wheel_radius=st.floats(0.01, 1.0),
    wheel_separation=st.floats(0.05, 5.0),
    wheel_separation_multiplier=factors,
    left_wheel_radius_multiplier=factors,
    right_wheel_radius_multiplier=factors,
)
twists = st.builds(Twist, st.floats(-10.0, 10.0), st.floats(-50.0, 50.0))


@each(("robot", "twist", "left", "right"), WHEELS_OF_TWIST)
def test_a_twist_gives_the_wheel_speeds_worked_by_hand(
    robot: DriveConfig, twist: Pair, left: float, right: float
) -> None:
    speeds = Kinematics(robot).wheel_speeds(Twist(*twist))
    assert speeds.as_tuple() == pytest.approx((right, left, left, right))


@each(("robot", "twist", "left", "right"), WHEELS_OF_TWIST)
def test_the_wheel_speeds_worked_by_hand_give_the_twist_back(
    robot: DriveConfig, twist: Pair, left: float, right: float
) -> None:
    back = Kinematics(robot).twist(WheelSpeeds(right, left, left, right))
    assert (back.linear, back.angular) == pytest.approx(twist)


@each(("robot", "wheels", "twist"), TWIST_OF_WHEELS)
def test_four_wheel_speeds_give_the_twist_worked_by_hand(
    robot: DriveConfig, wheels: tuple[float, float, float, float], twist: Pair
) -> None:
    result = Kinematics(robot).twist(WheelSpeeds(*wheels))
    assert (result.linear, result.angular) == pytest.approx(twist)


def test_rest_is_exactly_still_and_still_is_exactly_rest() -> None:
    kinematics = Kinematics(CALIBRATED)
    assert kinematics.wheel_speeds(REST) == STILL
    assert kinematics.twist(STILL) == REST


@given(robot=robots, twist=twists)
def test_converting_a_twist_to_wheel_speeds_and_back_keeps_the_twist(
    robot: DriveConfig, twist: Twist
) -> None:
    kinematics = Kinematics(robot)
    back = kinematics.twist(kinematics.wheel_speeds(twist))
    # v and w are the sum and the difference of the two sides, so each contains the other's error.
    track = robot.wheel_separation * robot.wheel_separation_multiplier
    # A float below 1e-300 has fewer digits.
    size = abs(twist.linear) + abs(twist.angular) * track + 1e-288
    assert back.linear == pytest.approx(twist.linear, abs=1e-12 * size)
    assert back.angular == pytest.approx(twist.angular, abs=1e-12 * size / track)


@given(robot=robots, twist=twists)
def test_the_two_wheels_of_a_side_turn_alike(robot: DriveConfig, twist: Twist) -> None:
    speeds = Kinematics(robot).wheel_speeds(twist)
    assert speeds.front_left == speeds.rear_left
    assert speeds.front_right == speeds.rear_right


def test_a_twist_within_the_wheel_speed_is_left_as_it_is() -> None:
    twist = Twist(0.3, 1.0)  # wheels at 3 and 9 rad/s
    assert Kinematics(DriveConfig()).saturate(twist, 9.1) is twist


def test_a_twist_beyond_the_wheel_speed_is_scaled_as_a_whole() -> None:
    # The wheels turn at 3 and 9 rad/s; a limit of 6 leaves two thirds of everything.
    result = Kinematics(DriveConfig()).saturate(Twist(0.3, 1.0), 6.0)
    assert (result.linear, result.angular) == pytest.approx((0.2, 2 / 3))


def test_the_limit_applies_to_the_faster_side_whichever_side_is_faster() -> None:
    kinematics = Kinematics(DriveConfig())
    for twist in (Twist(0.3, 1.0), Twist(0.3, -1.0), Twist(-0.3, 1.0), Twist(-0.3, -1.0)):
        speeds = kinematics.wheel_speeds(kinematics.saturate(twist, 6.0))
        assert max(map(abs, speeds.as_tuple())) == pytest.approx(6.0)


@given(robot=robots, twist=twists, most=st.floats(0.1, 99.99))
def test_saturation_keeps_the_curvature_and_no_wheel_is_too_fast(
    robot: DriveConfig, twist: Twist, most: float
) -> None:
    kinematics = Kinematics(robot)
    result = kinematics.saturate(twist, most)
    assert max(map(abs, kinematics.wheel_speeds(result).as_tuple())) <= most * (1 + 1e-9)
    assert result.linear * twist.angular == pytest.approx(result.angular * twist.linear)
    assert result.linear * twist.linear >= 0.0
    assert result.angular * twist.angular >= 0.0


@given(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0))
def test_the_speed_of_the_other_side_follows_from_the_turn(left: float, right: float) -> None:
    kinematics = Kinematics(DriveConfig(left_wheel_radius_multiplier=1.1))
    turn = kinematics.twist(WheelSpeeds(right, left, left, right)).angular
    assert kinematics.opposite(left, right, turn) == pytest.approx((left, right), abs=1e-9)
