"""Tests of the simulated base: motors with a lag, and the robot's path that follows from them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig, SimConfig
from acsard.core.simulator.vehicle import Vehicle
from tests.each import each

LAG = 0.1
RADIUS, TRACK = 0.05, 0.30

speed = st.floats(-50, 50)
four = st.lists(speed, min_size=4, max_size=4)


def vehicle(lag: float = LAG, drive: DriveConfig | None = None) -> Vehicle:
    return Vehicle(SimConfig(motor_time_constant=lag), drive or DriveConfig())


def moved(seconds: float, *set_points: float, lag: float = 0.0, **changes: float) -> Vehicle:
    """Return a vehicle after this time from rest; a, b, c, d are right, left, left, right."""
    made = vehicle(lag)
    for name, value in changes.items():
        setattr(made, name, value)
    made.set_points[:] = set_points
    made.advance(seconds)
    return made


def test_the_vehicle_stands_still_until_it_is_commanded_to_move() -> None:
    made = vehicle()
    made.advance(100.0)
    assert made.speeds == made.angles == [0.0] * 4
    assert (made.pose.x, made.pose.y, made.pose.yaw) == (0.0, 0.0, 0.0)


@each("seconds", [0.001, 0.05, 0.1, 0.5, 3.0])
def test_a_motor_approaches_its_set_point_exponentially(seconds: float) -> None:
    made = moved(seconds, 10.0, -5.0, 0.0, 2.0, lag=LAG)
    share = 1 - math.exp(-seconds / LAG)
    assert made.speeds == pytest.approx([10.0 * share, -5.0 * share, 0.0, 2.0 * share])
    turned = seconds - LAG * share
    assert made.angles == pytest.approx([10.0 * turned, -5.0 * turned, 0.0, 2.0 * turned])


def test_a_motor_reaches_63_percent_after_one_time_constant() -> None:
    assert moved(LAG, 10.0, 10.0, 10.0, 10.0, lag=LAG).speeds == pytest.approx(
        [6.3212] * 4, abs=1e-4
    )


def test_without_lag_a_motor_reaches_its_set_point_instantly() -> None:
    made = moved(0.001, 1.0, 2.0, 3.0, 4.0)
    assert made.speeds == [1.0, 2.0, 3.0, 4.0]
    assert made.angles == pytest.approx([0.001, 0.002, 0.003, 0.004])


@given(st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=12), four, four)
def test_speeds_and_angles_do_not_depend_on_the_time_steps(
    pieces: list[float], start: list[float], goal: list[float]
) -> None:
    whole, cut = vehicle(), vehicle()
    for made in (whole, cut):
        made.set_points[:] = start
        made.advance(0.2)
        made.set_points[:] = goal
    for piece in pieces:
        cut.advance(piece)
    whole.advance(sum(pieces))
    assert cut.speeds == pytest.approx(whole.speeds, abs=1e-6)
    assert cut.angles == pytest.approx(whole.angles, abs=1e-6)


@given(st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=12), speed, speed)
def test_a_path_from_rest_does_not_depend_on_the_time_steps(
    pieces: list[float], left: float, right: float
) -> None:
    whole, cut = vehicle(), vehicle()
    whole.set_points[:] = cut.set_points[:] = [right, left, left, right]
    for piece in pieces:
        cut.advance(piece)
    whole.advance(sum(pieces))
    assert (cut.pose.x, cut.pose.y) == pytest.approx((whole.pose.x, whole.pose.y), abs=1e-6)
    assert math.remainder(cut.pose.yaw - whole.pose.yaw, math.tau) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_a_time_step_of_zero_or_less_moves_nothing(dt: float) -> None:
    made = moved(1.0, 5.0, 5.0, 5.0, 5.0, lag=LAG)
    before = (list(made.speeds), list(made.angles), made.pose)
    made.advance(dt)
    assert (made.speeds, made.angles, made.pose) == before


def test_a_stopped_motor_comes_to_a_complete_rest() -> None:
    made = moved(1.0, 5.0, 5.0, 5.0, 5.0, lag=LAG)
    made.set_points[:] = [0.0] * 4
    made.advance(10.0)
    assert made.speeds == [0.0] * 4


def test_straight_ahead_the_distance_is_radius_times_angle() -> None:
    made = moved(2.0, 10.0, 10.0, 10.0, 10.0)
    assert made.pose.x == pytest.approx(10.0 * 2.0 * RADIUS)
    assert (made.pose.y, made.pose.yaw) == (0.0, 0.0)
    assert moved(2.0, -10.0, -10.0, -10.0, -10.0).pose.x == pytest.approx(-1.0)


def test_motors_a_and_d_are_on_the_right() -> None:
    assert moved(0.1, 1.0, -1.0, -1.0, 1.0).pose.yaw == pytest.approx(2 * 0.1 * RADIUS / TRACK)
    assert moved(0.1, 1.0, 0.0, 0.0, 1.0).pose.yaw > 0
    assert moved(0.1, 0.0, 1.0, 1.0, 0.0).pose.yaw < 0


def test_a_turn_on_the_spot_does_not_change_the_position() -> None:
    made = moved(0.7, 3.0, -3.0, -3.0, 3.0)
    assert (made.pose.x, made.pose.y) == pytest.approx((0.0, 0.0))


def test_a_quarter_circle_ends_one_radius_ahead_and_one_radius_to_the_side() -> None:
    # v = 0.5 m/s and w = 0.5 rad/s give a circle of 1 m radius.
    right, left = (0.5 + 0.5 * TRACK / 2) / RADIUS, (0.5 - 0.5 * TRACK / 2) / RADIUS
    made = moved(math.pi, right, left, left, right)
    assert (made.pose.x, made.pose.y) == pytest.approx((1.0, 1.0))
    assert made.pose.yaw == pytest.approx(math.pi / 2)


def test_the_mean_wheel_speed_of_each_side_moves_the_vehicle() -> None:
    assert moved(0.5, 6.0, 1.0, 5.0, 2.0).pose == moved(0.5, 4.0, 3.0, 3.0, 4.0).pose


def test_the_yaw_stays_within_half_a_turn() -> None:
    made = moved(12.0, 3.0, -3.0, -3.0, 3.0)
    assert made.pose.yaw == pytest.approx(math.remainder(12.0, math.tau))


def test_the_radius_multipliers_and_the_effective_track_shape_the_path() -> None:
    drive = DriveConfig(
        wheel_radius=0.1,
        wheel_separation=0.5,
        wheel_separation_multiplier=2.0,
        left_wheel_radius_multiplier=0.9,
        right_wheel_radius_multiplier=1.1,
    )
    made = vehicle(0.0, drive)
    made.set_points[:] = [1.0] * 4
    made.advance(0.5)
    assert made.pose.yaw == pytest.approx(0.5 * (0.11 - 0.09) / 1.0)
    assert math.hypot(made.pose.x, made.pose.y) == pytest.approx(0.5 * 0.1, rel=1e-4)


@pytest.mark.parametrize("slip", [0.0, 0.25, 1.0])
def test_slip_reduces_the_turn_by_its_share_but_not_the_distance(slip: float) -> None:
    turned = moved(0.1, 3.0, -3.0, -3.0, 3.0, turn_slip=slip)
    assert turned.pose.yaw == pytest.approx((1 - slip) * 0.1)
    assert turned.angles == pytest.approx([0.3, -0.3, -0.3, 0.3])
    assert moved(1.0, 3.0, 3.0, 3.0, 3.0, turn_slip=slip).pose.x == pytest.approx(0.15)


@pytest.mark.parametrize("load", [0.0, 0.25, 1.0])
def test_load_reduces_every_speed_by_its_share(load: float) -> None:
    made = moved(2.0, 10.0, 10.0, -10.0, 10.0, load=load)
    assert made.speeds == pytest.approx([s * (1 - load) for s in (10.0, 10.0, -10.0, 10.0)])
    assert made.angles == pytest.approx([s * (1 - load) * 2 for s in (10.0, 10.0, -10.0, 10.0)])


@pytest.mark.parametrize("speed", [0.5, -0.12])
def test_a_push_moves_the_vehicle_whatever_its_motors_do(speed: float) -> None:
    made = moved(1.0, 10.0, -10.0, 3.0, 0.0)
    before = made.pose
    made.advance(2.0, push=speed)
    assert made.speeds == pytest.approx([speed / RADIUS] * 4, rel=1e-6)
    made.set_points[:] = [0.0] * 4
    made.advance(1.0)
    assert made.speeds == [0.0] * 4
    assert math.dist((made.pose.x, made.pose.y), (before.x, before.y)) > 1.5 * abs(speed)


# properties that the host does not know

SPIN = (3.0, -3.0, -3.0, 3.0)
"""Set points that the host takes for 1 rad/s on the spot."""


def test_a_wider_true_track_reduces_the_true_turn() -> None:
    made = Vehicle(SimConfig(motor_time_constant=0.0, track_multiplier=1.6), DriveConfig())
    made.set_points[:] = SPIN
    made.advance(10.0)
    assert made.turned == pytest.approx(10.0 / 1.6)


def test_the_total_turn_counts_whole_turns_that_the_yaw_of_the_pose_wraps() -> None:
    made = moved(12.0, *SPIN)
    assert made.turned == pytest.approx(12.0)
    assert math.remainder(made.turned - made.pose.yaw, math.tau) == pytest.approx(0.0, abs=1e-9)
