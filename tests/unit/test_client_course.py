"""Ways by the odometry."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.client.course import Course, Straight, Turn
from acsard.client.driving import Driver, Steps, move, turn
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
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError
from tests.each import each
from tests.unit.screens import sample_of
from tests.unit.test_client_driving import STOPPED, Says, World, after, followed

PERIOD_S = 0.01


class Robot:
    """A robot at a pose that follows each command `delay_s` later, at most 1 m/s and 1 rad/s.

    Its odometry shows each `count` (m) of a wheel on the line y = -2.
    """

    def __init__(
        self, delay_s: float, yaw: float = 0.0, slip: float = 0.0, count: float = 0.0
    ) -> None:
        self.x, self.y, self.yaw, self._slip, self._count = 3.0, -2.0, yaw, slip, count
        self._commands = deque([REST] * round(delay_s / PERIOD_S))

    def odom(self) -> Odometry:
        count = self._count
        x = count * math.floor(self.x / count) if count else self.x
        pose = Pose(Vector3(x, self.y), from_yaw(self.yaw))
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
            self.yaw += (max(-1.0, min(1.0, twist.angular)) + self._slip) * PERIOD_S
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


@each("distance", [0.3, -0.305, 0.311])
@each("count", [0.008, 0.03])
def test_a_straight_course_ends_within_a_count_of_coarse_encoders(
    distance: float, count: float
) -> None:
    robot = Robot(0.05, count=count)
    robot.follow(Straight(robot.odom(), distance, 0.3))
    assert robot.x - 3.0 == pytest.approx(distance, abs=1.5 * count + 0.005)


@each("distance", [1.0, -1.0])
@each("slip", [0.05, -0.05])
def test_a_robot_that_drifts_is_steered_back_to_its_heading(distance: float, slip: float) -> None:
    """One side of the robot is faster by a twentieth of a radian a second."""
    robot = Robot(0.1, yaw=2.5, slip=slip)
    robot.follow(Straight(robot.odom(), distance, 0.3))
    assert abs(robot.yaw - 2.5) < 0.03
    beside = -(robot.x - 3.0) * math.sin(2.5) + (robot.y + 2.0) * math.cos(2.5)
    assert abs(beside) < 0.03


@each("way", [0.02, 0.1, 0.5, 2.0, 6.0])
def test_a_fast_robot_slows_down_at_a_rate_that_it_can_follow(way: float) -> None:
    speed = Straight(Robot(0.0).odom(), way, 9.0).twist.linear
    assert speed**2 / (2 * way) <= 0.3001
    assert speed == pytest.approx(min(math.sqrt(2 * 0.3 * way), 2.0 * way))


@each("degrees", [90.0, -720.0, 1.0, 0.0])
@each("delay_s", [0.0, 0.05])
def test_a_turn_ends_within_half_a_degree(degrees: float, delay_s: float) -> None:
    robot = Robot(delay_s, yaw=3.0)
    robot.follow(Turn(robot.odom(), math.radians(degrees), 0.8))
    assert math.degrees(robot.yaw - 3.0) == pytest.approx(degrees, abs=0.5)


@pytest.fixture(autouse=True)
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clock that also advances during a suspend show the time of the newest world."""
    monkeypatch.setattr(clock, "steady_s", lambda: World.newest.now)


class WithOdometry(World):
    """A robot that publishes its odometry for some time, and does not move."""

    def __init__(self, seconds: float, responder: Says = followed) -> None:
        super().__init__(responder)
        self.body = Robot(0.0)
        self.silent_s = seconds

    def subscribe(self, name: str) -> Any:
        if name == "state":
            return super().subscribe(name)
        queue: list[Any] = []

        def receive() -> Any:
            if not queue and self.passed < self.silent_s:
                queue.extend([sample_of(self.body.odom(), "acsard/acsar/odom"), None])
            return queue.pop(0) if queue else None

        return SimpleNamespace(try_recv=receive, undeclare=lambda: None)

    def move(self) -> None:
        robot: Any = self
        for pause in move(1.0, 0.3)(Driver(robot)):
            self.now += pause


def test_a_move_stops_when_the_odometry_falls_silent() -> None:
    world = WithOdometry(1.0)
    with pytest.raises(NoAnswerError, match="no odometry arrives"):
        world.move()
    assert 0.3 in world.sent
    # The error comes 2 s after the last message, and zeros from 0.2 s after it until rest.
    assert next(n for n, speed in enumerate(reversed(world.sent)) if speed) >= 10


def test_a_move_does_not_begin_without_a_state_that_counts_the_poses() -> None:
    world = WithOdometry(60.0)
    world.published = world.answers = False
    with pytest.raises(NoAnswerError, match="nothing received"):
        world.move()
    assert world.passed < 3.0
    assert world.sent == []


def test_a_move_of_a_robot_that_waits_for_its_board_ends_with_that_reason() -> None:
    missing = "/dev/ttyACM0 does not exist; plug the device in"
    world = WithOdometry(0.0, after(0.0, replace(STOPPED, mode="waiting", reason=missing)))
    with pytest.raises(NotDrivenError, match=missing):
        world.move()
    assert world.passed < 3.0
    assert world.sent == []


@each("fault", ["", "left wheel is blocked"])
def test_a_move_of_a_robot_that_does_not_move_ends_and_names_a_wheel_fault(fault: str) -> None:
    world = WithOdometry(60.0, lambda *args: replace(followed(*args), wheel_fault=fault))
    cause = fault or "is it blocked"
    with pytest.raises(NotDrivenError, match=rf"no nearer for 3 s, and 1\.000 m is left: {cause}"):
        world.move()
    assert 3.0 < world.passed < 4.0


class Rolling(WithOdometry):
    """A robot that follows each command, at once or behind a `lag` (s), `gain` times as fast."""

    def __init__(self, lag: float = 0.0, gain: float = 1.0) -> None:
        super().__init__(math.inf)
        self._lag, self._gain, self._speeds = lag, gain, (0.0, 0.0)
        self.linear = self.angular = self.way = self.turned = 0.0

    def send(self, linear: float, angular: float = 0.0) -> None:
        super().send(linear, angular)
        self.linear, self.angular = linear, angular

    def follow(
        self, steps: Steps, is_set: float = math.inf,
        by: tuple[float, float, float] = (3.0, 2.0, 2), sets: Callable[[], object] | None = None,
    ) -> None:  # fmt: skip
        """Drive a course, for at most 1000 s. After `is_set` s, the pose is set."""
        robot: Any = self
        body = self.body
        for pause in steps(Driver(robot)):
            self.now += pause
            assert self.now < 1100.0
            share = -math.expm1(-pause / self._lag) if self._lag else 1.0
            linear, angular = self._speeds
            linear += share * (self._gain * self.linear - linear)
            angular += share * (self._gain * self.angular - angular)
            self._speeds = linear, angular
            self.way += linear * pause
            self.turned += angular * pause
            body.x += linear * math.cos(body.yaw) * pause
            body.y += linear * math.sin(body.yaw) * pause
            body.yaw += angular * pause
            if self.passed >= is_set:
                x, y, yaw = by
                body.x, body.y, body.yaw, is_set = body.x + x, body.y + y, body.yaw + yaw, math.inf
                self.counters["poses_set"] = self.counters.get("poses_set", 0) + 1
                if sets is not None:
                    sets()


def test_a_long_way_at_a_low_speed_is_driven_to_its_end() -> None:
    world = Rolling()
    world.follow(move(6.0, 0.05))
    assert world.way == pytest.approx(6.0, abs=0.01)
    world = Rolling()
    world.follow(turn(720.0, 0.2))
    assert world.turned == pytest.approx(4 * math.pi, abs=0.02)


@each("lag", [0.2, 0.4])
def test_a_robot_that_rests_beyond_the_end_comes_back(lag: float) -> None:
    world = Rolling(lag)
    world.follow(move(1.0, 0.5))
    assert world.way == pytest.approx(1.0, abs=0.01)
    world = Rolling(lag)
    world.follow(turn(90.0, 2.0))
    assert world.turned == pytest.approx(math.pi / 2, abs=0.02)


def test_a_course_has_not_ended_if_the_odometry_falls_silent_before_the_rest() -> None:
    world = Rolling()
    world.follow(move(0.5, 0.3))
    silent_s = world.passed - 0.1
    world = Rolling()
    world.silent_s = silent_s
    with pytest.raises(NoAnswerError, match="no odometry arrives"):
        world.follow(move(0.5, 0.3))


def test_a_robot_that_misses_the_end_each_time_is_told_so() -> None:
    world = Rolling(0.2, gain=15.0)
    with pytest.raises(
        NotDrivenError, match=r"missed the end 5 times, and -?0\.\d+ m is left: try"
    ):
        world.follow(move(1.0, 0.3))


@each("by", [(3.0, -2.0, 2.0), (0.09, 0.0, 0.0), (0.0, 0.0, 0.18), (0.0, 0.0, -0.1), (0.0,) * 3])
def test_a_course_ends_if_the_pose_is_set_on_the_way(by: tuple[float, float, float]) -> None:
    world = Rolling()
    with pytest.raises(NotDrivenError, match="the pose was set"):
        world.follow(move(1.0, 0.3), is_set=2.0, by=by)
    assert world.way < 0.7
    world = Rolling()
    with pytest.raises(NotDrivenError, match="the pose was set"):
        world.follow(turn(90.0, 0.8), is_set=1.0, by=by)
    assert world.turned < 1.0


def test_a_course_ends_if_the_daemon_is_started_anew_on_the_way() -> None:
    world = Rolling()
    world.counters = {"poses_set": 5}

    def restart() -> None:
        world.counters = {"poses_set": 1}

    with pytest.raises(NotDrivenError, match="the daemon was started anew"):
        world.follow(move(1.0, 0.3), is_set=2.0, sets=restart)


def test_a_pose_that_was_set_before_a_course_or_in_its_last_moments_counts_likewise() -> None:
    world = Rolling()
    world.counters = {"poses_set": 5}
    world.follow(move(0.1, 0.3), is_set=0.0, by=(1.0, 1.0, 1.0))
    assert world.way == pytest.approx(0.1, abs=0.01)
    world = Rolling()
    world.follow(move(0.1, 0.3))
    ended = world.passed
    world = Rolling()
    with pytest.raises(NotDrivenError, match="the pose was set"):
        world.follow(move(0.1, 0.3), is_set=ended - 0.25, by=(0.0, 0.0, 0.0))
