"""A sound robot on a slope keeps a pose that is useful, although its wheels do not obey exactly."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from tests.scenarios.pose_faults import judged
from tests.scenarios.pose_nees import CALIBRATED
from tests.scenarios.world import World
from tests.wheels import FOUR, four_and_two

SHARE = 0.1
"""Of a speed that the slope takes away uphill, and adds downhill."""

FINE = replace(
    CALIBRATED, wheel_separation_multiplier_std=0.002, wheel_radius_ratio_std=1e-4,
    distance_variance_per_metre=1e-6, yaw_variance_per_metre=1e-7, yaw_variance_per_radian=1e-6,
)  # fmt: skip
"""So small that only the doubt of the wheels is left."""

Step = tuple[int, float, float]
"""Seconds, m/s and rad/s."""


def arcs(dice: random.Random) -> Step:
    return dice.choice((1, 2, 3)), dice.uniform(0.2, 0.7), dice.uniform(-1, 1)


def in_all_directions(dice: random.Random) -> Step:
    return dice.choice((1, 2, 3)), dice.uniform(-0.6, 0.7), dice.uniform(-1, 1)


def uphill(_: random.Random) -> Step:
    return 1, 0.5, 0.0


def tilted(world: World, share: float) -> None:
    """Let the motors turn slower up the slope, which rises along x, and faster down."""
    vehicle = world.mcu.vehicle

    def advance(dt: float, push: float | None = None) -> None:
        kept = list(vehicle.set_points)
        factor = 1.0 - share * math.cos(vehicle.pose.yaw)
        vehicle.set_points = [speed * factor for speed in kept]
        type(vehicle).advance(vehicle, dt, push)
        vehicle.set_points = kept

    vars(vehicle)["advance"] = advance


def driven(
    plan: Callable[[random.Random], Step], wheels: WheelMap, lag: float, share: float
) -> Iterator[World]:
    mcu = McuConfig(wheels=wheels, encoder_counts=3200)
    sim = SimConfig(encoder_counts=3200, motor_time_constant=lag)
    world, dice = World(Config(mcu=mcu, sim=sim, odometry=FINE)), random.Random(3)
    tilted(world, share)
    world.run(1.5)
    world.drive(0.2, 0.3, 0.5)
    for _ in range(25):
        seconds, linear, angular = plan(dice)
        world.hold(linear, angular, float(seconds))
        yield world


@pytest.mark.slow
@pytest.mark.variations(12)
@pytest.mark.parametrize("lag", [0.05, 0.2])
@pytest.mark.parametrize("plan", [arcs, in_all_directions, uphill])
@four_and_two
def test_on_a_slope_the_pose_is_as_uncertain_as_its_share_of_the_way(
    plan: Callable[[random.Random], Step], wheels: WheelMap, lag: float
) -> None:
    for world in driven(plan, wheels, lag, SHARE):
        value, _, (position, heading) = judged(world)
        way = world.loop.robot.state.odometry.travelled
        assert position < SHARE * way + 0.5
        assert heading < 0.6
        assert value < 3.0
    assert world.state.mode == "driving"


@pytest.mark.slow
@pytest.mark.variations(6)
@pytest.mark.parametrize("plan", [arcs, in_all_directions, uphill])
@pytest.mark.parametrize("lag", [0.02, 0.3])
def test_motors_that_are_later_or_earlier_than_expected_leave_little_in_doubt(
    plan: Callable[[random.Random], Step], lag: float
) -> None:
    for world in driven(plan, FOUR, lag, 0.0):
        _, _, (position, heading) = judged(world)
        way = world.loop.robot.state.odometry.travelled
        assert position < 0.02 * way + 0.5
        assert heading < 0.5
    assert world.state.pose_doubt == ""
