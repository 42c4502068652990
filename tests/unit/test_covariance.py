"""The covariance of the pose and the variances of the twist, worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from msgspec.structs import replace

from acsard.core.config.settings import WheelMap
from acsard.core.motion.gyro import Turn
from acsard.core.values import Pose, PoseCovariance, WheelSpeeds
from tests.each import each
from tests.unit.nees import PERIOD, RADIUS, TRACK
from tests.unit.odometer import MEASURED, Odometer
from tests.unit.test_pose import Says, counts, feedback, line, moves
from tests.wheels import MAPS

law = settings(max_examples=100)
START = PoseCovariance(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
"""The default covariance of a pose that was just set."""
EXACT = replace(
    MEASURED,
    distance_variance_per_metre=0.0,
    yaw_variance_per_metre=0.0,
    yaw_variance_per_radian=0.0,
)
Matrix = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def matrix(p: PoseCovariance) -> Matrix:
    rows = [[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]]
    return np.array(rows, dtype=np.float64)


def near(p: PoseCovariance, rel: float = 1e-4) -> object:
    # The equations hold to first order; second order adds some millionths to these variances.
    return pytest.approx(matrix(p), rel=rel, abs=1e-15)


def test_a_pose_that_is_set_is_as_certain_as_at_the_start_and_standing_adds_nothing() -> None:
    robot = Odometer()
    for _ in range(100):
        assert robot.fold(line(0.0)).covariance == START
    assert robot.fold(feedback(4.5, 7.5, 10.0)).covariance != START
    robot.set_pose(Pose(5.0, 5.0, 1.0))
    assert robot.fold(line(0.0)).covariance == START


def straight(metres: float, yaw: float = 0.0) -> PoseCovariance:
    """Return the covariance after a straight in this direction, driven forwards or backwards."""
    robot, speed = Odometer(), math.copysign(10.0, metres)
    robot.set_pose(Pose(0.0, 0.0, yaw))
    robot.fold(line(0.0))
    for _ in range(round(abs(metres) / 0.005)):
        robot.fold(line(speed))
    return robot.fold(line(0.0, 0.05)).covariance


@each("metres", [1.0, -1.0, 2.0])
def test_a_straight_adds_the_variance_worked_by_hand(metres: float) -> None:
    # The noise is 1e-4 per metre along x and 1e-4 per metre of yaw. A heading error at s shears y
    # by the rest of the way: yy has the integral of 1e-4 (d - s)^2, and yyaw that of 1e-4 (d - s).
    d, noise = abs(metres), 1e-4
    expected = PoseCovariance(
        1e-6 + noise * d, 0.0, 0.0,
        1e-6 + 1e-6 * d**2 + noise * d**3 / 3, metres * 1e-6 + noise * d * metres / 2,
        1e-6 + noise * d,
    )  # fmt: skip
    ahead, left = straight(metres), straight(metres, math.pi / 2)
    assert matrix(ahead) == near(expected, 2e-3)
    turned = PoseCovariance(ahead.yy, 0.0, -ahead.yyaw, ahead.xx, 0.0, ahead.yawyaw)
    assert matrix(left) == near(turned)


@each("sign", [1.0, -1.0])
def test_a_turn_in_place_makes_only_the_yaw_less_certain(sign: float) -> None:
    # 1 rad x 1e-2 per radian, less the play of a 400th of a turn: 2 pi / 400 x 0.05 / 0.3 rad. Each
    # side rolls 0.15 m. The side noise k = 1e-4 x 0.3 x 0.3 / 2 = 4.5e-6 makes up all of the yaw's
    # variance per metre. It gives 4.5e-6 x 0.3 / 0.09 = 1.5e-5 of yaw, and 4.5e-6 x 0.3 / 4 =
    # 3.375e-7 of position, a thousandth of the yaw's.
    robot = Odometer(replace(MEASURED, yaw_variance_per_metre=0.0))
    covariance = robot.fold(feedback(-3.0 * sign, 3.0 * sign, 1.0)).covariance
    yaw = 1e-6 + 1e-2 * (1 - math.pi / 1200)
    assert matrix(covariance) == near(PoseCovariance(1e-6, 0, 0, 1e-6, 0, yaw))
    covariance = Odometer().fold(feedback(-3.0 * sign, 3.0 * sign, 1.0)).covariance
    assert covariance.yawyaw == pytest.approx(yaw + 1.5e-5)
    assert covariance.xx + covariance.yy == pytest.approx(2e-6 + 3.375e-7)


def test_turning_to_and_fro_counts_both_ways_but_trembling_within_a_count_does_not() -> None:
    for sign in (1.0, -1.0):
        robot = Odometer()
        for turn in [15.0 * sign] * 100 + [-15.0 * sign] * 100:
            estimate = robot.fold(feedback(-turn, turn, 0.01))
        # The robot turns by 10 rad, less the play at the start and twice that at the reversal.
        assert estimate.covariance.yawyaw == pytest.approx(0.01 * 10.0, rel=0.05)
    robot = Odometer()
    for turn in [0.3, -0.3] * 2000:
        estimate = robot.fold(feedback(-turn, turn, 0.01))
    assert estimate.covariance.yawyaw < 2e-5


@each("wheels", MAPS)
def test_coarse_encoder_counts_make_the_pose_less_certain(wheels: WheelMap) -> None:
    covariance = Odometer(counts=20, wheels=wheels).fold(line(0.0)).covariance
    # A count is 15.7 mm, and a wheel may be anywhere in it at the start and now. Each side is the
    # mean of its wheels.
    count, on_a_side = 0.05 * math.tau / 20, len(wheels.names) / 2
    of_side = 2 * count**2 / 12 / on_a_side
    assert covariance.xx == pytest.approx(1e-6 + 2 * of_side / 4)
    assert covariance.yawyaw == pytest.approx(1e-6 + 2 * of_side / 0.3**2)


def yaw_variance(robot: Odometer) -> float:
    return robot.odometry.uncertainty.covariance.yawyaw


def metre(robot: Odometer) -> Matrix:
    """Return the growth of the covariance in 1 m to the front."""
    before = matrix(robot.fold(line(0.0)).covariance)
    for _ in range(200):
        robot.fold(line(10.0))
    return matrix(robot.fold(line(0.0, 0.05)).covariance) - before


@pytest.mark.slow
def test_a_long_way_makes_no_later_motion_less_certain() -> None:
    # Rounding adds nothing after 45 km and 100 000 rad, in 12 h at rest, and far from the origin.
    near, far = Odometer(), Odometer()
    near.set_pose(Pose())
    far.set_pose(Pose(45e3, 45e3))
    assert metre(far) == pytest.approx(metre(near), rel=1e-6, abs=1e-15)
    robot = Odometer(EXACT)
    for left, right in [(100.0, 100.0)] * 4500 + [(-300.0, 300.0)] * 500:
        robot.fold(feedback(left, right, 2.0))
    assert robot.odometry.travelled == pytest.approx(45_000)
    robot.model = near.model
    before = robot.fold(line(0.0)).covariance
    assert before.yawyaw == pytest.approx(1e-6)
    for _ in range(12 * 60):
        assert robot.fold(line(0.0, 60.0)).covariance == before
    for turn in [0.3, -0.3] * 2000:
        trembling = robot.fold(feedback(-turn, turn, 0.01)).covariance
    assert trembling.yawyaw - before.yawyaw < 3e-5
    assert metre(robot)[2, 2] == pytest.approx(1e-4)


def test_each_line_adds_the_variance_of_the_source_of_its_turn() -> None:
    robot = Odometer()

    def drive(lines: int, variance: float | None) -> None:
        robot.use(Says(always=None if variance is None else Turn(0.0, variance, 0.0, 1e-6)))
        for _ in range(lines):
            robot.fold(line(10.0))

    drive(21, 1e-2)
    before = yaw_variance(robot)
    assert before == pytest.approx(0.21 + 1e-6)
    # Each change of the source ends a stretch. 5 mm by the wheels add 5e-7.
    for _ in range(100):
        drive(2, None)
        drive(3, 1e-7)
    drive(1, None)
    assert yaw_variance(robot) - before == pytest.approx(201 * 5e-7 + 300 * 1e-7)


Moves = list[tuple[float, float, float]]


@law
@given(path=moves)
def test_the_covariance_is_positive_and_motion_makes_no_pose_more_certain(
    path: Moves,
) -> None:
    moved, gaps = Odometer(), Odometer()
    yaw, volume = START.yawyaw, float(np.linalg.det(matrix(START)))
    for left, right, dt in path:
        covariance = moved.fold(feedback(left, right, dt)).covariance
        grown = float(np.linalg.det(matrix(covariance)))
        assert covariance.yawyaw >= yaw
        assert grown >= volume * (1 - 1e-6)
        yaw, volume = covariance.yawyaw, grown
        # Motion lost on the way out may cancel motion lost on the way back.
        gap = dt * 10 if dt > 0.05 else 0.0
        lost = gaps.fold(feedback(left, right, 0.0 if gap else dt, gap=gap)).covariance
        eigenvalues = np.linalg.eigvalsh(matrix(lost))
        assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


# gaps


def after_gap(gap: float, linear: float, angular: float) -> PoseCovariance:
    """Return the covariance after a gap, s, from 0.3 m/s and 0.5 rad/s to this twist."""
    robot = Odometer()
    robot.fold(feedback(4.5, 7.5, 0.0))
    left, right = (linear - 0.15 * angular) / 0.05, (linear + 0.15 * angular) / 0.05
    return robot.fold(feedback(left, right, 0.0, gap=gap)).covariance


def test_a_gap_adds_the_distance_at_the_speeds_around_it_to_the_deviation() -> None:
    # The speed goes from 0.3 to 0.1 m/s at a constant 0.5 rad/s. The mean is 0.2 m/s and 0.5 rad/s,
    # and the bound is three times that.
    for gap in (0.15, 0.5):
        grown = matrix(after_gap(gap, 0.1, 0.5)) - matrix(START)
        assert (0.2 * gap) ** 2 <= grown[0, 0] <= 2 * (0.3 * gap) ** 2
        assert (0.5 * gap) ** 2 <= grown[2, 2] <= 3 * (0.5 * gap) ** 2
    # Ten gaps of 0.1 s at 0.5 m/s miss 0.5 m of the path, not 0.05 m x sqrt(10).
    robot = Odometer()
    for _ in range(10):
        robot.fold(line(10.0))
        estimate = robot.fold(line(10.0, 0.0, gap=0.1))
    assert math.sqrt(estimate.covariance.xx) == pytest.approx(0.5, rel=0.01)


def test_a_robot_that_nobody_watched_may_have_been_pushed_but_is_not_unknown() -> None:
    for gap, away, turned in ((3.0, 2.0, 1.0), (60.0, 10.0, 3.2), (1e9, 10.0, 3.2)):
        robot = Odometer()
        robot.fold(line(0.0))
        covariance = robot.fold(line(0.0, 0.0, gap=gap)).covariance
        deviations = [math.sqrt(v) for v in (covariance.xx, covariance.yy, covariance.yawyaw)]
        # The second without a line before adds 0.25 m along and 1 rad.
        assert deviations == pytest.approx([away, away, math.hypot(turned, 1.0)], rel=0.01)
        for _ in range(200):
            covariance = robot.fold(line(10.0), WheelSpeeds(*[10.0] * 4)).covariance
        assert covariance.xx < 200.0
        robot.set_pose(Pose(1.0, 2.0, 3.0))
        assert robot.fold(line(0.0)).covariance.xx < 1e-4
    robot = Odometer(replace(MEASURED, yaw_variance_per_metre=10.0))
    for _ in range(1000):  # an unknown heading adds no second order
        estimate = robot.fold(line(20.0))
    assert estimate.covariance.yawyaw > 90.0
    assert max(map(abs, robot.odometry.uncertainty.bend.added)) < 1.0


@each("wheels", MAPS)
@each("counts", [0, 16, 3200])
@each("lost", [0.01, 0.02])
def test_a_night_at_rest_with_lost_lines_costs_less_than_a_decimetre(
    lost: float, counts: int, wheels: WheelMap
) -> None:
    """12 hours of 100 lines a second, of which 1 % are lost, one by one or in pairs."""
    robot = Odometer(counts=counts, wheels=wheels)
    for _ in range(50):
        before = robot.fold(line(0.0)).covariance
    gaps, times = round(0.01 * 12 * 3600 / lost), 100  # each adds as much as the others
    for _ in range(gaps // times):
        after = robot.fold(line(0.0, lost + 0.01, bridged=lost)).covariance
    assert 0.0 < math.sqrt(times * (after.xx - before.xx)) < 0.1
    assert math.sqrt(times * (after.yawyaw - before.yawyaw)) < 0.1


@each("share", [0.0, 0.3, 1.0])
def test_a_pose_that_is_set_in_a_silence_knows_that_a_part_of_it_came_before(share: float) -> None:
    """The line that ends the silence has the counts of all of it, and none says when they came."""
    robot, turned = Odometer(), 8.0
    robot.fold(counts(0.1, speed=10.0))
    robot.set_pose(Pose(1.0, 2.0, 0.0))
    estimate = robot.fold(counts(turned, dt=0.0, gap=0.5))
    true = 1.0 + share * turned * RADIUS
    assert abs(estimate.pose.x - true) < 1.1 * math.sqrt(estimate.covariance.xx)
    assert estimate.positions == pytest.approx((0.1 + turned,) * 4)
    later = robot.fold(counts(0.1, speed=10.0))
    assert later.pose.x - estimate.pose.x == pytest.approx(0.1 * RADIUS)


# the twist


def test_the_twist_of_a_robot_at_rest_is_certain() -> None:
    robot = Odometer()
    robot.fold(line(1.0))
    for _ in range(19):
        moving = robot.fold(line(0.0)).twist_variances
    rest = robot.fold(line(0.0, 0.02)).twist_variances
    assert moving.lateral == 1e-3
    assert (rest.linear, rest.lateral, rest.angular) == (1e-8, 1e-8, 1e-8)
    assert robot.fold(feedback(0.0, 0.1, 0.01)).twist_variances.angular > 1e-8


@each("wheels", MAPS)
@each(("encoder", "resolution"), [(0, 0.01), (400, math.tau / 400 / PERIOD)])
def test_the_rounding_of_the_speeds_is_in_the_variances_of_the_twist(
    encoder: int, resolution: float, wheels: WheelMap
) -> None:
    robot = Odometer(EXACT, encoder, wheels=wheels)
    for _ in range(20):
        variances = robot.fold(feedback(4.0, 5.0, PERIOD)).twist_variances
    of_side = (RADIUS * resolution) ** 2 / 12 / (len(wheels.names) / 2)
    assert variances.angular == pytest.approx(2 * of_side / TRACK**2)
    assert variances.linear == pytest.approx(max(2 * of_side / 4, 1e-8))


def test_a_pose_integrated_from_twists_is_as_uncertain_as_the_odometry() -> None:
    robot, along, yaw = Odometer(), 0.0, 0.0
    for _ in range(1000):
        estimate = robot.fold(line(10.0, PERIOD))
        along += estimate.twist_variances.linear * PERIOD**2
        yaw += estimate.twist_variances.angular * PERIOD**2
    assert along == pytest.approx(estimate.covariance.xx, rel=0.1)
    assert yaw == pytest.approx(estimate.covariance.yawyaw, rel=0.1)
