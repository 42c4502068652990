"""The equations between a twist and the speeds of the wheels."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import REST, STILL, Twist, WheelSpeeds
from tests.each import each
from tests.vectors.drive import CALIBRATED, TWIST_OF_WHEELS, WHEELS_OF_TWIST

law = settings(max_examples=100)
Pair = tuple[float, float]


def pair(twist: Twist) -> Pair:
    return twist.linear, twist.angular


factors = st.floats(0.1, 10.0)
robots = st.builds(
    DriveConfig,
    wheel_radius=st.floats(0.01, 1.0),
    wheel_separation=st.floats(0.05, 5.0),
    wheel_separation_multiplier=factors,
    left_wheel_radius_multiplier=factors,
    right_wheel_radius_multiplier=factors,
)


@each(("robot", "twist", "left", "right"), WHEELS_OF_TWIST)
def test_a_twist_gives_the_wheel_speeds_worked_by_hand_and_they_give_it_back(
    robot: DriveConfig, twist: Pair, left: float, right: float
) -> None:
    kinematics = Kinematics(robot)
    wheels = WheelSpeeds(right, left, left, right)
    assert kinematics.wheel_speeds(Twist(*twist)).as_tuple() == pytest.approx(wheels.as_tuple())
    assert pair(kinematics.twist(wheels)) == pytest.approx(twist)


@each(("robot", "wheels", "twist"), TWIST_OF_WHEELS)
def test_four_wheel_speeds_give_the_twist_worked_by_hand(
    robot: DriveConfig, wheels: tuple[float, float, float, float], twist: Pair
) -> None:
    assert pair(Kinematics(robot).twist(WheelSpeeds(*wheels))) == pytest.approx(twist)


@law
@given(
    robot=robots,
    twist=st.builds(Twist, st.floats(-10.0, 10.0), st.floats(-50.0, 50.0)),
    most=st.floats(0.1, 99.99),
)
def test_there_and_back_keeps_the_twist_and_saturation_the_curvature(
    robot: DriveConfig, twist: Twist, most: float
) -> None:
    kinematics = Kinematics(robot)
    assert (kinematics.wheel_speeds(REST), kinematics.twist(STILL)) == (STILL, REST)
    speeds = kinematics.wheel_speeds(twist)
    assert (speeds.front_left, speeds.front_right) == (speeds.rear_left, speeds.rear_right)
    back = kinematics.twist(speeds)
    # v and w are the sum and the difference of the two sides, so each contains the other's error.
    # A float below 1e-300 has fewer digits.
    size = abs(twist.linear) + abs(twist.angular) * kinematics.track + 1e-288
    assert back.linear == pytest.approx(twist.linear, abs=1e-12 * size)
    assert back.angular == pytest.approx(twist.angular, abs=1e-12 * size / kinematics.track)
    slower = kinematics.saturate(twist, most)
    fastest = max(map(abs, kinematics.wheel_speeds(slower).as_tuple()))
    assert fastest <= most * (1 + 1e-9)
    assert slower is twist or fastest == pytest.approx(most)
    assert slower.linear * twist.angular == pytest.approx(slower.angular * twist.linear)
    assert slower.linear * twist.linear >= 0.0 <= slower.angular * twist.angular


@law
@given(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0))
def test_the_speed_of_the_other_side_follows_from_the_turn(left: float, right: float) -> None:
    kinematics = Kinematics(CALIBRATED)
    turn = kinematics.twist(WheelSpeeds(right, left, left, right)).angular
    assert kinematics.opposite(left, right, turn) == pytest.approx((left, right), abs=1e-9)
