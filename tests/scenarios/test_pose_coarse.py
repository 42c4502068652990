"""A robot drives with coarse encoders, whose counts per turn the daemon does not know."""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.config.contradictions import MOST_ASKED_HZ
from acsard.core.config.settings import Config, ControlConfig, McuConfig, SimConfig, WheelMap
from tests.scenarios.world import World
from tests.wheels import four_and_two


def driven(counts: int, wheels: WheelMap) -> World:
    """Return a robot with a free-running board that has driven at random and stopped."""
    mcu = McuConfig(reply_period=0.01, wheels=wheels)
    world, dice = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=counts))), random.Random(4)
    with world.mcu.fault("free_running", 0.01):
        world.run(0.5)
        for _ in range(4):
            world.drive(dice.choice((-1, 1)) * dice.uniform(0.3, 0.9), dice.uniform(-1, 1), 2.5)
        world.send(0.0)
        world.run(2.0)
    return world


def off(world: World) -> float:
    """Return the distance between the daemon's pose and the simulated robot, in m."""
    state, true = world.state, world.mcu.vehicle.pose
    return math.hypot(state.x - true.x, state.y - true.y)


@four_and_two
@pytest.mark.parametrize(
    "counts", [20, *(pytest.param(counts, marks=pytest.mark.slow) for counts in (16, 96, 400))]
)
def test_a_robot_that_reports_by_its_own_clock_is_where_its_lines_say(
    counts: int, wheels: WheelMap
) -> None:
    world = driven(counts, wheels)
    assert world.state.encoder_counts == [0] * len(wheels.names)
    assert ("coarse_encoder_lines" in world.state.counters) is (counts < 400)
    assert "line_implausible" not in world.state.counters
    assert not [event for event in world.events if event.name in ("fault", "lines_implausible")]
    # a count of each wheel at either end, twice that through the heading, and the shape of the arcs
    assert off(world) < 0.005 + 3 * math.tau / counts * 0.05


@pytest.mark.parametrize("configured", [True, False])
def test_no_count_is_counted_twice_at_the_highest_rate_of_a_board_without_counts(
    configured: bool,
) -> None:
    mcu = McuConfig(encoder_counts=400 * configured)
    control = ControlConfig(rate=MOST_ASKED_HZ)
    world = World(Config(control=control, mcu=mcu, sim=SimConfig(encoder_counts=400)))
    world.run(1.024)
    for linear, angular in ((0.0, 0.0), (0.2, 1.5), (0.0, 0.0)):
        world.drive(linear, angular, 4.0)
    turned = world.mcu.vehicle.pose.yaw - world.state.yaw
    assert abs(math.remainder(turned, math.tau)) < 0.03
