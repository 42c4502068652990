"""Tests of odometry: it integrates wheel speeds to pose, wheel angles and their uncertainty."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import OdometryConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gyro import Gyro, Turn
from acsard.core.motion.uncertainty import START_VARIANCE, UNKNOWN_POSE
from acsard.core.values import Estimate, Instant, Pose, PoseCovariance, Twist, WheelSpeeds
from tests.each import each
from tests.unit.core.motion.odometer import Odometer, arc
from tests.vectors.drive import (
    PATHS,
    SEED_STEP,
    SEED_STEP_ARC,
    SEED_STEP_POSE,
    SEED_STEP_TWIST,
)

AT = Instant(5_000_000_000, 1_800_000_000_000_000_000)
Three = tuple[float, float, float]

START = PoseCovariance(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
"""The default covariance of a pose that was just set."""

wheel_speed = st.floats(-40.0, 40.0)
moves = st.tuples(wheel_speed, wheel_speed, st.floats(0.0, 0.1))
"""One move as left and right (rad/s) and dt (s)."""


def odometry(settings: OdometryConfig | None = None, counts: int = 0) -> Odometer:
    return Odometer(settings or OdometryConfig(), counts)


def feedback(left: float, right: float, dt: float, gap: float = 0.0) -> Feedback:
    return Feedback(AT, WheelSpeeds(right, left, left, right), dt, gap)


LATER = feedback(20.0, 20.0, 0.01)


def same_pose(pose: Pose, expected: Three, tolerance: float = 1e-9) -> bool:
    """Return whether poses are equal within `tolerance`, ignoring whole turns of yaw."""
    turn = math.remainder(pose.yaw - expected[2], math.tau)
    return (pose.x, pose.y, turn) == pytest.approx((*expected[:2], 0.0), abs=tolerance)


def matrix(p: PoseCovariance) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array(
        [[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]], dtype=np.float64
    )


# the path


@pytest.mark.parametrize("steps", [1, 2, 10, 314])
@pytest.mark.parametrize(
    ("left", "right", "seconds", "pose"), [pytest.param(*path[1:], id=path[0]) for path in PATHS]
)
def test_a_path_ends_where_geometry_says_in_however_many_steps(
    left: float, right: float, seconds: float, pose: Three, steps: int
) -> None:
    robot = odometry()
    for _ in range(steps):
        robot.fold(feedback(left, right, seconds / steps))
    assert same_pose(robot.pose, pose)


def test_a_step_gives_the_twist_of_the_seed_equations() -> None:
    estimate = odometry().fold(feedback(*SEED_STEP))
    assert (estimate.twist.linear, estimate.twist.angular) == pytest.approx(SEED_STEP_TWIST)


def test_a_step_ends_on_the_arc() -> None:
    estimate = odometry().fold(feedback(*SEED_STEP))
    assert same_pose(estimate.pose, SEED_STEP_ARC, tolerance=1e-10)


def test_the_seed_equations_end_less_than_a_millimetre_beside_the_arc() -> None:
    assert not same_pose(odometry().fold(feedback(*SEED_STEP)).pose, SEED_STEP_POSE, 1e-4)
    assert same_pose(odometry().fold(feedback(*SEED_STEP)).pose, SEED_STEP_POSE, 1e-3)


@settings(max_examples=25)
@given(distance=st.floats(-2.0, 2.0), turn=st.floats(-7.0, 7.0), yaw=st.floats(-3.0, 3.0))
def test_the_arc_is_the_limit_of_many_small_steps_of_the_seed_equations(
    distance: float, turn: float, yaw: float
) -> None:
    x, y, heading, steps = 0.0, 0.0, yaw, 4000
    for _ in range(steps):
        x += distance / steps * math.cos(heading)
        y += distance / steps * math.sin(heading)
        heading += turn / steps
    # the error of small steps is of second order per step
    error = abs(distance * turn) / steps + 1e-9
    assert same_pose(arc(Pose(0.0, 0.0, yaw), distance, turn), (x, y, heading), error)


@given(
    pose=st.builds(Pose, st.floats(-9, 9), st.floats(-9, 9), st.floats(-3.1, 3.1)),
    distance=st.floats(-2.0, 2.0),
    turn=st.floats(-7.0, 7.0),
)
def test_an_arc_driven_back_ends_where_it_began(pose: Pose, distance: float, turn: float) -> None:
    there = arc(pose, distance, turn)
    assert same_pose(arc(there, -distance, -turn), (pose.x, pose.y, pose.yaw))


@given(distance=st.floats(-2.0, 2.0), turn=st.floats(-7.0, 7.0), share=st.floats(0.0, 1.0))
def test_an_arc_in_two_parts_is_the_same_arc(distance: float, turn: float, share: float) -> None:
    whole = arc(Pose(), distance, turn)
    first = arc(Pose(), distance * share, turn * share)
    second = arc(first, distance * (1 - share), turn * (1 - share))
    assert same_pose(second, (whole.x, whole.y, whole.yaw))


@each("turn", [0.0, 5e-324, 1e-300, 1e-20, 1e-12, 1e-9, -1e-9])
def test_an_arc_of_hardly_any_turn_is_a_straight_line(turn: float) -> None:
    assert same_pose(arc(Pose(), 1.0, turn), (1.0, 0.0, turn))


@given(path=st.lists(moves, max_size=30))
def test_there_and_back_the_same_way_ends_where_it_began(
    path: list[tuple[float, float, float]],
) -> None:
    robot = odometry()
    for left, right, dt in path:
        robot.fold(feedback(left, right, dt))
    for left, right, dt in reversed(path):
        robot.fold(feedback(-left, -right, dt))
    assert same_pose(robot.pose, (0.0, 0.0, 0.0))
    assert robot.fold(feedback(0.0, 0.0, 0.0)).positions == pytest.approx((0.0,) * 4, abs=1e-9)


@each("turns", [0, 1, 10, 1000, -1, -10, -1000])
def test_yaw_is_wrapped_however_many_turns_one_step_makes(turns: int) -> None:
    # Turning in place at 3 rad/s gives a yaw rate of 1 rad/s.
    wheel = 3.0 * (1.0 + turns * math.tau)
    estimate = odometry().fold(feedback(-wheel, wheel, 1.0))
    assert estimate.pose.yaw == pytest.approx(1.0, abs=1e-9)


@given(turns=st.lists(st.floats(-10.0, 10.0), max_size=50))
def test_yaw_stays_within_half_a_turn(turns: list[float]) -> None:
    robot = odometry()
    for turn in turns:
        assert abs(robot.fold(feedback(-3.0 * turn, 3.0 * turn, 1.0)).pose.yaw) <= math.pi
    assert same_pose(robot.pose, (0.0, 0.0, sum(turns)))


# the estimate


def test_a_sample_has_the_stamp_the_speeds_and_the_twist_of_its_line() -> None:
    speeds = WheelSpeeds(4.0, 1.0, 3.0, 8.0)
    estimate = odometry().fold(Feedback(AT, speeds, 0.01))
    assert (estimate.at, estimate.speeds) == (AT, speeds)
    assert (estimate.twist.linear, estimate.twist.angular) == pytest.approx((0.2, 2 / 3))


def test_each_wheel_turns_by_its_own_speed() -> None:
    robot = odometry()
    robot.fold(Feedback(AT, WheelSpeeds(1.0, 2.0, -3.0, 4.0), 0.05))
    estimate = robot.fold(Feedback(AT, WheelSpeeds(1.0, 0.0, -1.0, 0.0), 0.025))
    assert estimate.positions == pytest.approx((0.075, 0.1, -0.175, 0.2))


def test_wheel_angles_are_continuous_past_a_turn() -> None:
    robot = odometry()
    estimate = robot.fold(feedback(10.0, 10.0, 100.0))
    assert estimate.positions == (1000.0,) * 4


def test_the_last_twist_and_speeds_can_be_asked_for() -> None:
    robot = odometry()
    assert (robot.odometry.twist, robot.odometry.speeds) == (Twist(), WheelSpeeds())
    estimate = robot.fold(feedback(3.0, 9.0, 0.01))
    assert (robot.odometry.twist, robot.odometry.speeds, robot.pose) == (
        estimate.twist,
        estimate.speeds,
        estimate.pose,
    )


def test_the_first_line_moves_nothing() -> None:
    estimate = odometry().fold(feedback(10.0, 10.0, 0.0))
    assert (estimate.pose, estimate.positions) == (Pose(), (0.0,) * 4)
    assert estimate.covariance == START


def test_a_gap_moves_neither_pose_nor_wheels() -> None:
    robot = odometry()
    before = robot.fold(feedback(10.0, 10.0, 0.1))
    after = robot.fold(feedback(10.0, 10.0, 0.0, gap=5.0))
    assert (after.pose, after.positions) == (before.pose, before.positions)
    assert after.speeds == before.speeds


def test_setting_the_pose_wraps_its_yaw() -> None:
    robot = odometry()
    robot.set_pose(Pose(1.0, 2.0, 7.0))
    assert robot.pose == Pose(1.0, 2.0, math.remainder(7.0, math.tau))
    assert robot.pose.yaw == pytest.approx(7.0 - 2 * math.pi)


def test_setting_the_pose_makes_it_as_certain_as_at_the_start() -> None:
    robot = odometry()
    assert robot.fold(feedback(4.5, 7.5, 10.0)).covariance != START
    robot.set_pose(Pose(5.0, 5.0, 1.0))
    assert robot.fold(feedback(0.0, 0.0, 0.01)).covariance == START


# the covariance


def approx(p: PoseCovariance) -> object:
    # The equations hold to first order; second order adds some millionths to these variances.
    return pytest.approx(matrix(p), rel=1e-4, abs=1e-15)


def test_at_the_start_the_pose_is_nearly_certain() -> None:
    start = odometry().fold(feedback(0.0, 0.0, 0.01)).covariance
    assert start == PoseCovariance(1e-6, 0, 0, 1e-6, 0, 1e-6)


def straight(metres: float, yaw: float = 0.0) -> PoseCovariance:
    """Return the covariance after a straight in this direction, driven forwards or backwards."""
    robot, speed = odometry(), math.copysign(10.0, metres)
    robot.set_pose(Pose(0.0, 0.0, yaw))
    robot.fold(feedback(0.0, 0.0, 0.01))
    for _ in range(round(abs(metres) / 0.005)):
        robot.fold(feedback(speed, speed, 0.01))
    return robot.fold(feedback(0.0, 0.0, 0.05)).covariance


@pytest.mark.parametrize("metres", [1.0, -1.0, 2.0])
def test_a_straight_adds_the_variance_worked_by_hand(metres: float) -> None:
    # The noise is 1e-4 per metre along x and 1e-4 per metre of yaw. A heading error at s shears y
    # by the rest of the way: yy has the integral of 1e-4 (d - s)^2, and yyaw that of 1e-4 (d - s).
    d, noise = abs(metres), 1e-4
    expected = PoseCovariance(
        1e-6 + noise * d, 0.0, 0.0,
        1e-6 + 1e-6 * d**2 + noise * d**3 / 3, metres * 1e-6 + noise * d * metres / 2,
        1e-6 + noise * d,
    )  # fmt: skip
    assert matrix(straight(metres)) == pytest.approx(matrix(expected), rel=2e-3, abs=1e-15)


def test_facing_left_the_roles_of_x_and_y_change() -> None:
    ahead, left = straight(1.0), straight(1.0, math.pi / 2)
    expected = PoseCovariance(ahead.yy, 0.0, -ahead.yyaw, ahead.xx, 0.0, ahead.yawyaw)
    assert matrix(left) == approx(expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_in_place_makes_only_the_yaw_less_certain(sign: float) -> None:
    # 1 rad x 1e-2 per radian, less the play of a 400th of a turn: 2 pi / 400 x 0.05 / 0.3 rad. Each
    # side rolls 0.15 m. The side noise k = 1e-4 x 0.3 x 0.3 / 2 = 4.5e-6 makes up all of the yaw's
    # variance per metre. It gives 4.5e-6 x 0.3 / 0.09 = 1.5e-5 of yaw, and 4.5e-6 x 0.3 / 4 =
    # 3.375e-7 of position, a thousandth of the yaw's.
    robot = odometry(OdometryConfig(yaw_variance_per_metre=0.0))
    covariance = robot.fold(feedback(-3.0 * sign, 3.0 * sign, 1.0)).covariance
    yaw = 1e-6 + 1e-2 * (1 - math.pi / 1200)
    assert matrix(covariance) == approx(PoseCovariance(1e-6, 0, 0, 1e-6, 0, yaw))
    covariance = odometry().fold(feedback(-3.0 * sign, 3.0 * sign, 1.0)).covariance
    assert covariance.yawyaw == pytest.approx(yaw + 1.5e-5)
    assert covariance.xx + covariance.yy == pytest.approx(2e-6 + 3.375e-7)


def test_standing_adds_no_uncertainty() -> None:
    robot = odometry()
    for _ in range(100):
        estimate = robot.fold(feedback(0.0, 0.0, 0.01))
    assert estimate.covariance == START


def covariance_after_gap(gap: float, linear: float, angular: float) -> PoseCovariance:
    """Return the covariance after a gap of this length, s.

    The twist is 0.3 m/s and 0.5 rad/s before the gap, and `linear` and `angular` after it.
    """
    robot = odometry()
    robot.fold(feedback(4.5, 7.5, 0.0))
    left, right = (linear - 0.15 * angular) / 0.05, (linear + 0.15 * angular) / 0.05
    return robot.fold(feedback(left, right, 0.0, gap=gap)).covariance


@pytest.mark.parametrize("gap", [0.15, 0.5])
def test_a_gap_adds_the_distance_at_the_speeds_around_it_to_the_deviation(gap: float) -> None:
    # The speed goes from 0.3 to 0.1 m/s at a constant 0.5 rad/s. The mean is 0.2 m/s and 0.5 rad/s,
    # and the bound is three times that.
    grown = matrix(covariance_after_gap(gap, 0.1, 0.5)) - matrix(START)
    assert (0.2 * gap) ** 2 <= grown[0, 0] <= 2 * (0.3 * gap) ** 2
    assert (0.5 * gap) ** 2 <= grown[2, 2] <= 3 * (0.5 * gap) ** 2


def test_a_longer_gap_makes_the_pose_less_certain() -> None:
    ways = [covariance_after_gap(gap, 0.3, 0.5) for gap in (0.1, 0.2, 0.5, 1.0, 2.0)]
    for cell in ("xx", "yy", "yawyaw"):
        grown = [getattr(way, cell) for way in ways]
        assert grown == sorted(grown)
        assert len(set(grown)) == 5


def test_the_errors_of_several_gaps_add_up_without_cancelling() -> None:
    # Ten gaps of 0.1 s at 0.5 m/s miss 0.5 m of the path, not 0.05 m x sqrt(10).
    robot = odometry()
    for _ in range(10):
        robot.fold(feedback(10.0, 10.0, 0.01))
        estimate = robot.fold(feedback(10.0, 10.0, 0.0, gap=0.1))
    assert math.sqrt(estimate.covariance.xx) == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("dt", [0.11, 0.0], ids=["filled", "not filled"])
def test_a_gyro_measures_the_turn_of_a_gap_between_speeds_of_single_counts(dt: float) -> None:
    robot = odometry()
    robot.use(Says(always=Turn(0.0, 1e-6, 0.0, 1e-3)))
    for speed in (0.0, 6.5, 0.0, 6.5):
        estimate = robot.fold(feedback(speed, speed, 0.01))
    before, gap = estimate.covariance, 0.11 - dt
    line = replace(feedback(0.0, 0.0, dt, gap), bridged=max(0.0, dt - 0.01))
    after = robot.fold(line).covariance
    assert after.xx > before.xx + 1e-5
    assert after.yawyaw < before.yawyaw + 1e-5


def test_a_gap_of_a_robot_that_stood_before_and_after_adds_nothing() -> None:
    robot = odometry()
    robot.fold(feedback(0.0, 0.0, 0.01))
    assert robot.fold(feedback(0.0, 0.0, 0.0, gap=2.0)).covariance == START


def fold_all(robot: Odometer, path: list[tuple[float, float, float]]) -> list[Estimate]:
    """Pass each (left, right, dt) to odometry.

    A `dt` above 0.09 s gives a gap of ten times `dt`.
    """
    return [
        robot.fold(
            feedback(left, right, 0.0, gap=dt * 10) if dt > 0.09 else feedback(left, right, dt)
        )
        for left, right, dt in path
    ]


@given(path=st.lists(moves, min_size=1, max_size=50))
def test_the_covariance_is_always_positive(path: list[tuple[float, float, float]]) -> None:
    for estimate in fold_all(odometry(), path):
        eigenvalues = np.linalg.eigvalsh(matrix(estimate.covariance))
        assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


@given(path=st.lists(moves, min_size=1, max_size=50))
def test_moving_never_makes_the_pose_more_certain(
    path: list[tuple[float, float, float]],
) -> None:
    # The path has no gaps, because motion lost on the way out may cancel motion lost on the way
    # back.
    yaw, volume = START.yawyaw, float(np.linalg.det(matrix(START)))
    for estimate in fold_all(odometry(), [(le, r, min(dt, 0.09)) for le, r, dt in path]):
        grown = float(np.linalg.det(matrix(estimate.covariance)))
        assert estimate.covariance.yawyaw >= yaw
        assert grown >= volume * (1 - 1e-6)
        yaw, volume = estimate.covariance.yawyaw, grown


def test_the_further_the_robot_drives_the_less_certain_it_is() -> None:
    near, far = odometry(), odometry()
    for step in range(1000):
        far_sample = far.fold(feedback(9.0, 10.0, 0.01))
        if step < 500:
            near_sample = near.fold(feedback(9.0, 10.0, 0.01))
    near_p, far_p = near_sample.covariance, far_sample.covariance
    assert far_p.xx > near_p.xx
    assert far_p.yy > near_p.yy
    assert far_p.yawyaw > near_p.yawyaw


def test_a_gap_of_years_leaves_a_variance_of_1e9_and_no_more() -> None:
    robot = odometry()
    robot.fold(feedback(4.5, 7.5, 0.0))
    covariance = robot.fold(feedback(4.5, 7.5, 0.0, gap=1e9)).covariance
    assert (covariance.xx, covariance.yy, covariance.yawyaw) == (1e9, 1e9, 1e9)
    assert robot.fold(feedback(4.5, 7.5, 1.0, gap=1.0)).covariance == UNKNOWN_POSE


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 1e6], ids=["driving", "gaps"])
def test_the_covariance_stays_finite_for_years(gap: float) -> None:
    robot = odometry(
        OdometryConfig(
            distance_variance_per_metre=10.0,
            yaw_variance_per_metre=10.0,
            yaw_variance_per_radian=10.0,
        )
    )
    for _ in range(20_000):
        estimate = robot.fold(feedback(40.0, 40.0, 0.0 if gap else 100.0, gap))
        robot.fold(feedback(40.0, 40.0, 1.0))
    values = matrix(estimate.covariance)
    assert np.isfinite(values).all()
    assert np.diag(values).max() >= 1e9
    assert np.abs(values).max() < 1e15


# counts


def counted(*turned: float, dt: float = 0.01, gap: float = 0.0, speed: float = 0.0) -> Feedback:
    """Return a line whose wheels turned by these angles, rad. A single number is for all wheels."""
    a, b, c, d = turned if len(turned) == 4 else turned * 4
    return Feedback(AT, WheelSpeeds(*(speed,) * 4), dt, gap, (a, b, c, d))


def test_counts_move_the_robot_and_its_wheels_whatever_the_speed_and_duration_of_the_line() -> None:
    estimate = odometry().fold(counted(2.0, dt=99.0, speed=50.0))
    assert same_pose(estimate.pose, (0.1, 0.0, 0.0))
    assert estimate.positions == (2.0, 2.0, 2.0, 2.0)
    assert estimate.twist.linear == pytest.approx(2.5)


@given(path=st.lists(moves, max_size=30))
def test_counts_that_agree_with_the_speeds_make_the_same_path(
    path: list[tuple[float, float, float]],
) -> None:
    by_speed, by_counts = odometry(), odometry()
    for robot in (by_speed, by_counts):
        robot.fold(feedback(9.0, 9.0, 0.0))
    for left, right, dt in path:
        by_speed.fold(feedback(left, right, dt))
        by_counts.fold(counted(right * dt, left * dt, left * dt, right * dt))
    pose = by_speed.pose
    assert same_pose(by_counts.pose, (pose.x, pose.y, pose.yaw))


def test_counts_over_a_gap_add_no_uncertainty_of_the_gap() -> None:
    by_gap, at_once = odometry(), odometry()
    by_gap.fold(counted(0.0, speed=10.0))
    bridged = by_gap.fold(counted(5.0, dt=0.0, gap=0.5, speed=10.0))
    whole = at_once.fold(counted(5.0, speed=10.0))
    assert same_pose(bridged.pose, (whole.pose.x, whole.pose.y, whole.pose.yaw))
    assert bridged.covariance == whole.covariance


def test_a_skipped_line_leaves_its_time_to_the_next() -> None:
    robot = odometry()
    robot.skip(feedback(90.0, 90.0, 0.01))
    estimate = robot.fold(feedback(10.0, 10.0, 0.01))
    assert estimate.pose.x == pytest.approx(0.005 + 0.0025)  # half of the speed after it
    assert robot.fold(feedback(10.0, 10.0, 0.01)).pose.x == pytest.approx(0.0125)


@pytest.mark.parametrize("after", [counted(1.0), feedback(20.0, 20.0, 0.05)])
def test_the_counts_of_skipped_lines_are_not_lost(after: Feedback) -> None:
    robot = odometry()
    for _ in range(10):
        robot.skip(counted(1.0, speed=99.0))
    assert robot.fold(after).pose.x == pytest.approx(0.05 * 11)
    assert robot.fold(counted(0.0)).positions == pytest.approx((11.0,) * 4)


def test_the_speed_of_a_bridged_time_is_linear_between_two_reports() -> None:
    robot = odometry()
    robot.fold(feedback(10.0, 10.0, 0.01))
    before = robot.pose.x
    robot.fold(Feedback(AT, WheelSpeeds(20.0, 20.0, 20.0, 20.0), 0.03, bridged=0.02))
    assert robot.pose.x - before == pytest.approx((15.0 * 0.02 + 20.0 * 0.01) * 0.05)


# the turn of a gyro


class Says(Gyro):
    """A gyro that always reports the same turn."""

    always: Turn | None = None

    def turn(self, *line: object) -> Turn | None:
        return self.always


def line(seconds: float, dt: float, speeds: WheelSpeeds, **more: Any) -> Feedback:
    return Feedback(Instant(int(seconds * 1e9), 0), speeds, dt, **more)


@pytest.mark.parametrize("turned", [None, (0.2, 0.1, 0.1, 0.2)])
def test_the_wheels_give_only_the_distance_when_a_gyro_gives_the_turn(
    turned: tuple[float, float, float, float] | None,
) -> None:
    speeds, wheels, gyro = WheelSpeeds(20.0, 10.0, 10.0, 20.0), Odometer(), Odometer()
    by_wheels = wheels.fold(line(1.0, 0.01, speeds, turned=turned))
    gyro.use(Says(always=Turn(0.05, 1e-4, 4.0, 1e-3)))
    by_gyro = gyro.fold(line(1.0, 0.01, speeds, turned=turned))
    assert by_gyro.pose.yaw == pytest.approx(0.05)
    assert by_gyro.pose.yaw != pytest.approx(by_wheels.pose.yaw, rel=0.1)
    assert by_gyro.twist == Twist(by_wheels.twist.linear, 4.0)
    assert by_gyro.positions == by_wheels.positions
    assert gyro.odometry.travelled == pytest.approx(wheels.odometry.travelled)
    more = by_gyro.covariance.yawyaw - START_VARIANCE
    assert more == pytest.approx(1e-4, rel=1e-3)  # the gyro's scale adds 0.2 mrad


def test_the_gyro_gives_the_turn_over_a_gap() -> None:
    robot = Odometer()
    robot.use(Says(always=Turn(0.3, 1e-4, 0.7, 1e-3)))
    estimate = robot.fold(line(1.0, 0.0, WheelSpeeds(), gap=0.4))
    assert estimate.pose == Pose(0.0, 0.0, 0.3)


# at rest


def at_rest(robot: Odometer) -> Estimate:
    for _ in range(25):
        estimate = robot.fold(counted(0.0))
    return estimate


def test_the_twist_of_a_robot_at_rest_is_certain() -> None:
    robot = odometry()
    robot.fold(feedback(1.0, 1.0, 0.01))
    for _ in range(19):
        moving = robot.fold(feedback(0.0, 0.0, 0.01)).twist_variances
    rest = robot.fold(feedback(0.0, 0.0, 0.02)).twist_variances
    assert moving.lateral == 1e-3
    assert (rest.linear, rest.lateral, rest.angular) == (1e-8, 1e-8, 1e-8)
    assert robot.fold(feedback(0.0, 0.1, 0.01)).twist_variances.angular > 1e-8


def test_a_count_to_and_fro_at_rest_moves_nothing() -> None:
    robot = odometry()
    before = at_rest(robot)
    for _ in range(1000):
        robot.fold(counted(0.002))
        after = robot.fold(counted(-0.002))
    assert (after.pose, after.covariance, after.positions) == (
        before.pose,
        before.covariance,
        before.positions,
    )


def test_a_count_that_was_undone_at_rest_does_not_move_the_robot_later() -> None:
    robot = odometry()
    at_rest(robot)
    for turned in (0.002, -0.002):
        robot.fold(counted(turned))
    assert robot.fold(counted(0.1, speed=10.0)).positions == pytest.approx((0.1,) * 4)


def test_a_wheel_that_creeps_back_count_by_count_is_not_held() -> None:
    robot = odometry()
    at_rest(robot)
    robot.fold(counted(0.002))
    for _ in range(100):
        estimate = robot.fold(counted(-0.002))
    assert estimate.positions == pytest.approx((-0.198,) * 4, abs=0.01)


def test_no_count_of_a_rest_is_lost() -> None:
    robot = odometry()
    at_rest(robot)
    for _ in range(10):
        robot.fold(counted(0.002))
    estimate = robot.fold(counted(0.002, speed=1.0))
    assert estimate.positions == pytest.approx((0.022,) * 4)
    assert estimate.pose.x == pytest.approx(0.022 * 0.05)


def test_a_robot_that_creeps_too_slowly_for_two_decimals_moves() -> None:
    robot = odometry()
    at_rest(robot)
    for _ in range(1000):
        estimate = robot.fold(counted(0.001))
    assert estimate.pose.x == pytest.approx(1.0 * 0.05, abs=0.05 * 0.04)


def test_coarse_encoder_counts_make_the_pose_less_certain() -> None:
    coarse = odometry(counts=20)
    covariance = coarse.fold(feedback(0.0, 0.0, 0.01)).covariance
    # A count is 15.7 mm, and a wheel may be anywhere in it at the start and now. Each side is the
    # mean of two wheels.
    count = 0.05 * math.tau / 20
    assert covariance.xx == pytest.approx(1e-6 + 2 * count**2 / 12 / 4)
    assert covariance.yawyaw == pytest.approx(1e-6 + 2 * count**2 / 12 / 0.3**2)


def test_gaps_and_bridged_times_are_counted_but_a_gap_at_rest_is_not() -> None:
    robot = Odometer()
    at, moving = Instant(0, 0), WheelSpeeds(5.0, 5.0, 5.0, 5.0)
    robot.fold(Feedback(at, WheelSpeeds(), 0.0, gap=2.0))
    assert robot.odometry.counters() == {}
    robot.fold(Feedback(at, moving, 0.01))
    robot.fold(Feedback(at, moving, 0.0, gap=0.25))
    robot.fold(Feedback(at, moving, 0.04, bridged=0.03))
    assert robot.odometry.counters() == {"gaps": 1, "gap_ms": 250, "gaps_filled_ms": 30}


# whole counts of a single line


def snapped(turned: float, dt: float = 0.01, speed: float = 9.99, bridged: float = 0.0) -> Feedback:
    speeds = WheelSpeeds(speed, speed, speed, speed)
    return Feedback(AT, speeds, dt, bridged=bridged, counted=(turned,) * 4)


def test_the_whole_counts_of_a_line_give_its_distance_whatever_its_speed_and_time() -> None:
    robot = odometry()
    for dt in (0.01, 0.003, 0.017):
        robot.fold(snapped(0.1, dt))
    assert robot.pose.x == pytest.approx(3 * 0.1 * 0.05)


def test_the_motion_of_a_bridged_time_is_added_to_the_counts_of_a_line() -> None:
    robot = odometry()
    robot.fold(snapped(0.1, dt=0.02, speed=10.0))
    robot.fold(snapped(0.1, dt=0.03, speed=10.0, bridged=0.02))
    assert robot.pose.x == pytest.approx((0.1 + 0.2 + 0.1) * 0.05)


def test_the_speeds_around_it_replace_a_skipped_line() -> None:
    robot = odometry()
    robot.fold(snapped(0.1, speed=10.0))
    robot.skip(snapped(5.0, speed=99.0))
    robot.fold(snapped(0.1, speed=10.0))
    assert robot.pose.x == pytest.approx((0.1 + 0.1 + 0.1) * 0.05)
