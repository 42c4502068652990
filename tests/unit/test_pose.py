"""The pose by odometry: the path, counts, gaps, skipped lines, and a robot at rest."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import WheelMap
from acsard.core.link.feedback import Line
from acsard.core.motion.gaps import Rolled, Skipped, rolled_over
from acsard.core.motion.gyro import Gyro, Turn
from acsard.core.values import (
    STILL,
    Estimate,
    Instant,
    Pose,
    Twist,
    WheelSpeeds,
)
from tests.each import each
from tests.unit.odometer import MEASURED, Odometer
from tests.vectors.drive import PATHS, SEED_STEP, SEED_STEP_ARC, SEED_STEP_TWIST
from tests.wheels import FOUR, MAPS, TWO

law = settings(max_examples=100)
AT = Instant(5_000_000_000, 1_800_000_000_000_000_000)
SURE = replace(
    MEASURED,
    distance_variance_per_metre=1e-8,
    yaw_variance_per_metre=1e-8,
    yaw_variance_per_radian=1e-8,
)
Three = tuple[float, float, float]
wheel_speed = st.floats(-40.0, 40.0)
moves = st.lists(st.tuples(wheel_speed, wheel_speed, st.floats(0.0, 0.1)), max_size=30)
"""Moves as left and right (rad/s) and dt (s)."""


def feedback(left: float, right: float, dt: float, **more: Any) -> Line:
    return Line(AT, WheelSpeeds(right, left, left, right), dt, **more)


def line(speed: float, dt: float = 0.01, **more: Any) -> Line:
    return feedback(speed, speed, dt, **more)


def counts(*turned: float, speed: float = 0.0, dt: float = 0.01, gap: float = 0.0) -> Line:
    """Return a line whose wheels turned by these angles, rad. A single number is for all wheels."""
    return line(speed, dt, gap=gap, turned=turned if len(turned) == 4 else turned * 4)


def same_pose(pose: Pose, expected: Three, tolerance: float = 1e-9) -> bool:
    """Return whether poses are equal within `tolerance`, ignoring whole turns of yaw."""
    turn = math.remainder(pose.yaw - expected[2], math.tau)
    return (pose.x, pose.y, turn) == pytest.approx((*expected[:2], 0.0), abs=tolerance)


# the path


@each("steps", [1, 2, 10, 314])
@each("path", PATHS)
def test_a_path_ends_where_geometry_says_in_however_many_steps(path: Any, steps: int) -> None:
    robot, (_, left, right, seconds, pose) = Odometer(), path
    for _ in range(steps):
        robot.fold(feedback(left, right, seconds / steps))
    assert same_pose(robot.pose, pose)


def test_a_step_has_the_twist_of_the_seed_equations_and_ends_on_the_arc() -> None:
    estimate = Odometer().fold(feedback(*SEED_STEP))
    assert (estimate.twist.linear, estimate.twist.angular) == pytest.approx(SEED_STEP_TWIST)
    assert same_pose(estimate.pose, SEED_STEP_ARC, tolerance=1e-10)


@law
@given(path=moves)
def test_there_and_back_the_same_way_ends_where_it_began(path: list[Three]) -> None:
    robot = Odometer()
    for left, right, dt in path:
        robot.fold(feedback(left, right, dt))
    for left, right, dt in reversed(path):
        robot.fold(feedback(-left, -right, dt))
    assert same_pose(robot.pose, (0.0, 0.0, 0.0))
    assert robot.fold(line(0.0, 0.0)).positions == pytest.approx((0.0,) * 4, abs=1e-9)


@law
@given(turns=st.lists(st.floats(-1000.0, 1000.0), max_size=50))
def test_yaw_stays_within_half_a_turn(turns: list[float]) -> None:
    robot = Odometer()  # turning in place at 3 rad/s gives a yaw rate of 1 rad/s
    for turn in turns:
        assert abs(robot.fold(feedback(-3.0 * turn, 3.0 * turn, 1.0)).pose.yaw) <= math.pi
    assert same_pose(robot.pose, (0.0, 0.0, sum(turns)), 1e-8)


# counts


@law
@given(path=moves)
def test_counts_that_agree_with_the_speeds_make_the_same_path(path: list[Three]) -> None:
    by_speed, by_counts = Odometer(), Odometer()
    for robot in (by_speed, by_counts):
        robot.fold(line(9.0, 0.0))
    for left, right, dt in path:
        by_speed.fold(feedback(left, right, dt))
        by_counts.fold(counts(right * dt, left * dt, left * dt, right * dt))
    pose = by_speed.pose
    assert same_pose(by_counts.pose, (pose.x, pose.y, pose.yaw))


@each("after", [counts(1.0), line(20.0, 0.05)])
def test_the_counts_of_skipped_lines_are_not_lost(after: Line) -> None:
    robot = Odometer()
    for _ in range(10):
        robot.skip(counts(1.0, speed=99.0))
    assert robot.fold(after).pose.x == pytest.approx(0.05 * 11)
    assert robot.fold(counts(0.0)).positions == pytest.approx((11.0,) * 4)


# gaps and skipped lines


def roll(feedback: Line, *skipped: Line) -> Rolled:
    """Return how far a line rolls whose wheels turned at 10 rad/s before it."""
    before = Skipped()
    for one in skipped:
        before.add(one)
    return rolled_over(before, feedback, (10.0,) * 4, (10.0,) * 4, (10.0,) * 4, 4)


@each(
    ("lines", "angle", "seconds", "filled", "unknown"),
    [
        # A gap has the mean of the speeds at its ends. Counts need no filling; whole counts are of
        # the line alone.
        ([line(20.0, 0.31, bridged=0.3)], 15 * 0.3 + 20 * 0.01, 0.31, 0.3, 0.0),
        ([line(20.0, 0.31, bridged=0.3, turned=(7.0,) * 4)], 7.0, 0.31, 0.0, 0.0),
        ([line(20.0, 0.31, bridged=0.3, counted=(0.1,) * 4)], 15 * 0.3 + 0.1, 0.31, 0.3, 0.0),
        # Skipped lines leave their time and their counts to the next one, but not for a second.
        (
            [line(20.0), line(99.0, turned=(1.0,) * 4), line(99.0, 0.02)],
            1.0 + 15.0 * 0.02 + 20.0 * 0.01, 0.04, 0.02, 0.0,
        ),
        ([line(20.0), line(9.0, 0.0, gap=0.5), *[line(9.0)] * 101], 0.2, 0.01, 0.0, 1.51),
        ([line(20.0), line(9.0, counted=(5.0,) * 4)], 0.15 + 0.2, 0.02, 0.01, 0.0),
    ],
)  # fmt: skip
def test_how_far_a_line_rolls(
    lines: list[Line], angle: float, seconds: float, filled: float, unknown: float
) -> None:
    rolled = roll(*lines)
    assert rolled.angles == pytest.approx((angle,) * 4)
    times = rolled.seconds, rolled.filled, rolled.unknown
    assert times == pytest.approx((seconds, filled, unknown))


@each("wheels", MAPS)
@each("wheel", range(2))
@each("speed", [0.0, 10.0])
@each("false", [-30.0, 0.0, 18.0, 50.0])
@each(("seconds", "bridged"), [(0.07, 0.0), (0.25, 0.0), (0.11, 0.1), (0.31, 0.3), (0.91, 0.9)])
def test_a_false_speed_after_a_gap_or_in_a_long_line_does_not_make_a_wrong_pose_certain(
    seconds: float, bridged: float, false: float, speed: float, wheel: int, wheels: WheelMap
) -> None:
    """The line may be right, so the pose uses it, and says how wrong it may be."""
    robot, driven = Odometer(SURE, wheels=wheels), WheelSpeeds(*[speed] * 4)
    for _ in range(30):
        robot.fold(line(speed), driven)
    speeds = [speed] * 4
    speeds[wheel] = false
    if wheels is TWO:
        speeds[3 - wheel] = false
    robot.fold(Line(AT, WheelSpeeds(*speeds), seconds, bridged=bridged), driven)
    pose, covariance = robot.pose, robot.fold(line(speed), driven).covariance
    way = speed * 0.05 * (0.3 + seconds)
    off, turned = math.dist((pose.x, pose.y), (way, 0.0)), abs(pose.yaw)
    assert turned < 1.2 * math.sqrt(covariance.yawyaw)
    assert off < 1.2 * math.sqrt(covariance.xx + covariance.yy)


@each("wheels", MAPS)
@each("end", ["before", "after"])
@each("true", [-10.0, 10.0])
@each(("silence", "gap"), [(0.1, 0.0), (0.3, 0.0), (0.9, 0.0), (0.0, 1.5)])
def test_a_false_speed_beside_a_gap_takes_no_doubt_of_another_gap_away(
    silence: float, gap: float, true: float, end: str, wheels: WheelMap
) -> None:
    """The robot was turned in the first gap. In the second one it rests, and one line is false."""
    robot = Odometer(SURE, wheels=wheels)

    def silent(speed: float, dt: float = 0.01) -> Line:
        rear = speed if wheels is TWO else 0.0
        speeds = WheelSpeeds(speed, 0.0, 0.0, rear)
        return Line(AT, speeds, silence + dt if silence else 0.0, gap=gap, bridged=silence)

    def rest() -> Estimate:
        return [robot.fold(line(0.0), STILL) for _ in range(30)][-1]

    rest()
    robot.fold(silent(true), STILL)
    before = rest().covariance
    if end == "before":
        robot.fold(replace(silent(-true), dt=0.01, gap=0.0, bridged=0.0))
    turned = robot.pose.yaw
    robot.fold(silent(0.0 if end == "before" else -true))
    after = rest().covariance
    off = abs(robot.pose.yaw - turned)
    assert after.yawyaw >= before.yawyaw
    assert off < 1.2 * math.sqrt(after.yawyaw - before.yawyaw)


def accelerated(wheels: WheelMap, period: float) -> Estimate:
    """Return where a robot ends that obeys each command, with lines of this period."""
    robot, speed = Odometer(wheels=wheels), 0.0
    for goal in (10.0, -5.0, 0.0):
        while speed != goal:
            change = max(-20.0 * period, min(goal - speed, 20.0 * period))
            speed = round(speed + change, 2)
            estimate = robot.fold(line(speed, period), WheelSpeeds(*[goal] * 4))
    return estimate


@each("wheels", MAPS)
def test_a_robot_that_obeys_is_as_certain_with_long_lines_as_with_short_ones(
    wheels: WheelMap,
) -> None:
    long, short = accelerated(wheels, 0.1), accelerated(wheels, 0.01)
    assert long.covariance.xx < 1.2 * short.covariance.xx


@each("wheels", MAPS)
@each("silence", [0.02, 0.2, 0.9])
def test_one_damaged_speed_behind_a_silence_is_no_fault_of_a_wheel_that_stopped(
    wheels: WheelMap, silence: float
) -> None:
    robot = Odometer(wheels=wheels)
    for _ in range(100):
        robot.fold(line(1.0), WheelSpeeds(1.0, 1.0, 1.0, 1.0))
    for n in range(80):
        robot.fold(line(round(0.8**n, 2)), STILL)
    rear = 0.0 if wheels == FOUR else 80.0  # the only wheel of a side
    robot.fold(Line(AT, WheelSpeeds(80.0, 0.0, 0.0, rear), silence + 0.01, bridged=silence))
    faults = [robot.checks.wheels.fault]
    for _ in range(200):
        robot.fold(line(0.0))
        faults.append(robot.checks.wheels.fault)
    assert set(faults) == {None}


def test_gaps_and_bridged_times_are_counted() -> None:
    robot = Odometer()
    assert robot.odometry.counters() == {}
    robot.fold(line(5.0))
    robot.fold(line(5.0, 0.0, gap=0.25))
    robot.fold(line(5.0, 0.04, bridged=0.03))
    assert robot.odometry.counters() == {"gaps": 1, "gap_ms": 250, "gaps_filled_ms": 30}
    robot.skip(line(5.0, 0.0, gap=0.5))
    robot.fold(line(5.0))
    assert robot.odometry.counters() == {"gaps": 2, "gap_ms": 750, "gaps_filled_ms": 30}


# the turn of a gyro


class Says(Gyro):
    """A gyro that always reports the same turn."""

    always: Turn | None = None

    def turn(self, *line: object) -> Turn | None:
        return self.always


@each("turned", [None, (0.2, 0.1, 0.1, 0.2)])
def test_the_wheels_give_only_the_distance_when_a_gyro_gives_the_turn(turned: Any) -> None:
    wheels, gyro = Odometer(), Odometer()
    gyro.use(Says(always=Turn(0.05, 1e-4, 4.0, 1e-3)))
    by_wheels = wheels.fold(feedback(10.0, 20.0, 0.01, turned=turned))
    by_gyro = gyro.fold(feedback(10.0, 20.0, 0.01, turned=turned))
    assert by_gyro.pose.yaw == pytest.approx(0.05)
    assert by_gyro.twist == Twist(by_wheels.twist.linear, 4.0)
    assert by_gyro.positions == by_wheels.positions
    assert gyro.odometry.travelled == pytest.approx(wheels.odometry.travelled)
    # The gyro's scale adds 3 % of 0.05 rad to the 1e-6 of the start.
    assert by_gyro.covariance.yawyaw - 1e-6 == pytest.approx(1e-4 + 0.0015**2, rel=1e-3)
    gyro.use(Says(always=Turn(0.3, 1e-4, 0.7, 1e-3)))  # over a gap too
    assert gyro.fold(line(0.0, 0.0, gap=0.4)).pose.yaw == pytest.approx(0.35)


# at rest


def at_rest() -> tuple[Odometer, Estimate]:
    robot = Odometer()
    return robot, [robot.fold(counts(0.0)) for _ in range(25)][-1]


def test_a_count_to_and_fro_at_rest_moves_nothing_then_or_later() -> None:
    robot, before = at_rest()
    for _ in range(1000):
        robot.fold(counts(0.002))
        after = robot.fold(counts(-0.002))
    for name in ("pose", "covariance", "positions"):
        assert getattr(after, name) == getattr(before, name)
    assert robot.fold(counts(0.1, speed=10.0)).positions == pytest.approx((0.1,) * 4)


@each(
    ("first", "then", "times", "end", "slack"),
    [
        (0.002, -0.002, 100, -0.198, 0.01),  # it creeps back count by count
        (0.0, 0.001, 1000, 1.0, 0.04),  # too slowly for two decimals
    ],
)
def test_a_wheel_that_creeps_is_not_held(
    first: float, then: float, times: int, end: float, slack: float
) -> None:
    robot, _ = at_rest()
    robot.fold(counts(first))
    for _ in range(times):
        estimate = robot.fold(counts(then))
    assert estimate.positions == pytest.approx((end,) * 4, abs=slack)
    assert estimate.pose.x == pytest.approx(end * 0.05, abs=slack * 0.05)
