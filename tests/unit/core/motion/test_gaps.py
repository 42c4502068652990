"""Tests of the gaps in the feedback: the motion that fills them, and what it may be wrong by."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsard.core.config.settings import LimitsConfig, OdometryConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gaps import AT_REST, LONG_S, Rolled, Skipped, rolled_over
from acsard.core.values import STILL, Instant, Pose, WheelSpeeds
from tests.unit.core.motion.odometer import Odometer

AT = Instant(0, 0)
RADIUS = 0.05
EXACT = OdometryConfig(
    distance_variance_per_metre=0.0, yaw_variance_per_metre=0.0, yaw_variance_per_radian=0.0
)


def all_four(speed: float) -> WheelSpeeds:
    return WheelSpeeds(speed, speed, speed, speed)


def line(speed: float, dt: float = 0.01, **more: Any) -> Feedback:
    return Feedback(AT, all_four(speed), dt, **more)


def roll(skipped: Skipped, feedback: Feedback, before: float = 10.0) -> Rolled:
    return rolled_over(skipped, feedback, (before,) * 4)


def test_a_gap_has_the_mean_of_the_speeds_at_its_ends() -> None:
    rolled = roll(Skipped(), line(20.0, 0.31, bridged=0.3))
    assert rolled.angles == pytest.approx((15.0 * 0.3 + 20.0 * 0.01,) * 4)
    assert rolled.seconds == pytest.approx(0.31)
    assert (rolled.filled, rolled.unknown) == (0.3, 0.0)


def test_counts_need_no_filling() -> None:
    rolled = roll(Skipped(), line(20.0, 0.31, bridged=0.3, turned=(7.0,) * 4))
    assert rolled == Rolled((7.0,) * 4, 0.31, 0.0, 0.0)


def test_whole_counts_are_of_the_line_alone() -> None:
    rolled = roll(Skipped(), line(20.0, 0.31, bridged=0.3, counted=(0.1,) * 4))
    assert rolled.angles == pytest.approx((15.0 * 0.3 + 0.1,) * 4)


def test_skipped_lines_leave_their_time_and_their_counts_to_the_next_one() -> None:
    skipped = Skipped()
    skipped.add(line(99.0, 0.01, turned=(1.0,) * 4))
    skipped.add(line(99.0, 0.02))
    rolled = roll(skipped, line(20.0))
    assert rolled.angles == pytest.approx((1.0 + 15.0 * 0.02 + 20.0 * 0.01,) * 4)
    assert rolled.seconds == pytest.approx(0.04)
    assert rolled.filled == 0.02


def test_a_second_of_skipped_lines_is_unknown_motion() -> None:
    skipped = Skipped()
    skipped.add(line(99.0, 0.0, gap=0.5))
    for _ in range(101):
        skipped.add(line(99.0))
    rolled = roll(skipped, line(20.0))
    assert rolled.angles == pytest.approx((0.2,) * 4)
    assert rolled.unknown == pytest.approx(0.5 + 1.01)


@pytest.mark.parametrize("wheel", range(4))
def test_a_wheel_that_alone_is_fast_after_a_gap_does_not_fill_it(wheel: int) -> None:
    speeds = [0.0] * 4
    speeds[wheel] = 40.0
    damaged = Feedback(AT, WheelSpeeds(*speeds), 0.31, bridged=0.3)
    assert rolled_over(Skipped(), damaged, AT_REST).angles == AT_REST
    robot = Odometer()
    robot.fold(line(0.0))
    assert robot.fold(Feedback(AT, WheelSpeeds(*speeds), LONG_S + 0.04)).pose == Pose()


# bounds


def driven(accelerations: list[float], gap: tuple[int, int]) -> tuple[float, float, float]:
    """Drive with lines every 10 ms, of which those in `gap` are lost.

    Returns the true distance, that of the odometry, and its standard deviation, m.
    """
    robot, speed, true, lost = Odometer(EXACT), 0.0, 0.0, 0
    for number, acceleration in enumerate(accelerations):
        # A report is the mean of its period.
        before, speed = speed, max(0.0, min(1.0, speed + acceleration * 0.01))
        true += (before + speed) / 2 * 0.01
        if gap[0] <= number < gap[1]:
            lost += 1
            continue
        filled, lost = lost * 0.01, 0
        mean = (before + speed) / 2 / RADIUS
        estimate = robot.fold(line(mean, 0.01 + filled, bridged=filled, driven=1.0))
    return true, estimate.pose.x, math.sqrt(estimate.covariance.xx - 1e-6)


@pytest.mark.parametrize("seconds", [0.05, 0.15, 0.3, 0.9])
def test_a_filled_gap_of_a_robot_within_its_limits_is_in_the_covariance(seconds: float) -> None:
    """The acceleration changes at random in the gap, between the configured limits."""
    dice, limit = np.random.default_rng(3), LimitsConfig().linear_acceleration
    length = round(seconds * 100)
    worst = 0.0
    for _ in range(300):
        phases = dice.uniform(-limit, limit, 30).repeat(10).tolist()
        begin = int(dice.integers(20, 180))
        true, found, std = driven([limit] * 50 + phases, (begin, begin + length))
        worst = max(worst, abs(found - true) / std)
        assert abs(found - true) <= limit * seconds**2 / 4 + 0.01 * limit * seconds
    assert worst < 3.0


def test_errors_of_many_equal_silences_add_up() -> None:
    """In each silence the robot brakes at its end, so that the trapezoid lacks the same motion."""
    robot, true = Odometer(EXACT), 0.0
    for _ in range(50):
        robot.fold(line(10.0, 0.01, driven=1.0))
        estimate = robot.fold(line(0.0, 0.31, bridged=0.3, driven=0.3))
        true += 10.0 * RADIUS * 0.31
    missing = true - estimate.pose.x
    assert missing == pytest.approx(50 * 10.0 * RADIUS * 0.15, rel=0.1)
    assert missing < 2.0 * math.sqrt(estimate.covariance.xx)


def test_a_robot_that_was_commanded_to_move_may_have_moved_between_two_rests() -> None:
    for driven_s, moved in ((0.3, True), (-0.2, False)):
        robot = Odometer(EXACT)
        start = robot.fold(line(0.0)).covariance
        for more in ({"dt": 0.51, "bridged": 0.5}, {"dt": 0.0, "gap": 0.5}):
            estimate = robot.fold(Feedback(AT, STILL, **more, driven=driven_s))  # type: ignore[arg-type]
            assert (estimate.covariance.xx > start.xx + 0.05**2) == moved
            start = estimate.covariance


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_pose_that_is_set_in_a_silence_knows_that_a_part_of_it_came_before(share: float) -> None:
    """The line that ends the silence has the counts of all of it, and none says when they came."""
    robot, turned = Odometer(), 8.0
    robot.fold(line(10.0, turned=(0.1,) * 4))
    robot.set_pose(Pose(1.0, 2.0, 0.0))
    estimate = robot.fold(line(0.0, 0.0, gap=0.5, turned=(turned,) * 4))
    true = 1.0 + share * turned * RADIUS
    assert abs(estimate.pose.x - true) < 1.1 * math.sqrt(estimate.covariance.xx)
    assert estimate.positions == pytest.approx((0.1 + turned,) * 4)
    later = robot.fold(line(10.0, turned=(0.1,) * 4))
    assert later.pose.x - estimate.pose.x == pytest.approx(0.1 * RADIUS)
