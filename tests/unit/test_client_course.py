"""Ways by the odometry."""

from __future__ import annotations

import math
from collections import deque

import pytest

from acsard.client.course import Course, Straight, Turn
from acsard.core.messages.report import from_yaw
from acsard.core.messages.schema import (
    Header,
    Odometry,
    Pose,
    PoseWithCovariance,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.values import REST
from tests.each import each

PERIOD_S = 0.01


class Robot:
    """A robot at a pose that follows each command `delay_s` later, at most 1 m/s and 1 rad/s."""

    def __init__(self, delay_s: float, yaw: float = 0.0) -> None:
        self.x, self.y, self.yaw = 3.0, -2.0, yaw
        self._commands = deque([REST] * round(delay_s / PERIOD_S))

    def odom(self) -> Odometry:
        pose = Pose(Vector3(self.x, self.y), from_yaw(self.yaw))
        zeros = [0.0] * 36
        return Odometry(
            Header(Time(12, 250_000_000), "odom"),
            "base_link",
            PoseWithCovariance(pose, zeros),
            TwistWithCovariance(Twist(Vector3(), Vector3()), zeros),
        )

    def follow(self, course: Course) -> None:
        """Drive the course to its end, and until the robot rests."""
        for _ in range(10_000):
            course.odom(self.odom())
            self._commands.append(REST if course.is_done else course.twist)
            twist = self._commands.popleft()
            self.yaw += max(-1.0, min(1.0, twist.angular)) * PERIOD_S
            self.x += twist.linear * math.cos(self.yaw) * PERIOD_S
            self.y += twist.linear * math.sin(self.yaw) * PERIOD_S
            if course.is_done and set(self._commands) <= {REST}:
                return
        raise AssertionError(course.left_text)


@each("distance", [1.0, -0.5, 0.01, 0.0])
@each("delay_s", [0.0, 0.1])
def test_a_straight_course_ends_within_five_millimetres(distance: float, delay_s: float) -> None:
    robot = Robot(delay_s, yaw=2.5)
    robot.follow(Straight(robot.odom(), distance, 0.3))
    way = math.hypot(robot.x - 3.0, robot.y + 2.0)
    assert way == pytest.approx(abs(distance), abs=0.005)
    assert robot.x - 3.0 == pytest.approx(distance * math.cos(2.5), abs=0.005)


@each("degrees", [90.0, -720.0, 1.0, 0.0])
@each("delay_s", [0.0, 0.05])
def test_a_turn_ends_within_half_a_degree(degrees: float, delay_s: float) -> None:
    robot = Robot(delay_s, yaw=3.0)
    robot.follow(Turn(robot.odom(), math.radians(degrees), 0.8))
    assert math.degrees(robot.yaw - 3.0) == pytest.approx(degrees, abs=0.5)


def test_a_robot_that_is_pushed_aside_on_a_straight_course_turns_back() -> None:
    robot = Robot(0.05)
    course = Straight(robot.odom(), 1.0, 0.3)
    robot.yaw = 0.3
    robot.follow(course)
    assert robot.yaw == pytest.approx(0.0, abs=0.02)
