"""Encoders and motors fail one wheel at a time; the robot stops and names the wheel."""

from __future__ import annotations

import pytest

from acsard.config.settings import Config, McuConfig, WheelMap
from acsard.sim.faults import Fault
from acsard.values import WHEELS
from tests.scenarios.world import World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def stopped(world: World) -> bool:
    return world.mcu.vehicle.set_points == [0.0] * 4


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("kind", ["stuck", "reversed", "runaway"])
def test_a_lying_encoder_stops_the_robot_and_is_named(world: World, wheel: int, kind: str) -> None:
    world.drive(0.5, seconds=1.5)
    faults: dict[str, Fault] = {
        "stuck": world.mcu.stuck_encoder(wheel),
        "reversed": world.mcu.bias(wheel, -1.0),
        "runaway": world.mcu.bias(wheel, 2.0),
    }
    with faults[kind]:
        world.hold(0.5, seconds=2.0)
        assert world.state.mode == "fault"
        assert WHEELS[wheel] in world.state.reason
        assert stopped(world)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "fault"
    assert world.call("clear").success
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


def test_a_motor_wired_the_other_way_round_is_found_out() -> None:
    # The simulator wires itself as configured, so its encoder alone is turned here.
    world = World(Config(mcu=McuConfig(wheels=WheelMap(rear_left="-c"))))
    world.run(0.2)
    with world.mcu.bias(2, -1.0):
        world.drive(0.3, seconds=2.0)
    assert "rear_left wheel turns against its command" in world.state.reason


def test_one_impossible_line_is_dropped_and_costs_no_distance(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.bias(1, 9.0):
        world.hold(0.5, seconds=0.011, hz=100.0)
    world.hold(0.5, seconds=1.0)
    world.send(0.0)
    world.run(1.0)
    assert world.state.counters["line_impossible"] >= 1
    assert world.state.mode == "ready"
    assert world.state.x == pytest.approx(world.mcu.vehicle.pose.x, abs=0.005)


def test_repeated_impossible_lines_are_a_fault_within_thirty_milliseconds(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    x = world.state.x
    with world.mcu.bias(3, 9.0):
        world.hold(0.5, seconds=0.05, hz=20.0)
        assert world.state.mode == "fault"
        assert "rear_right" in world.state.reason
        world.run(1.0)
    assert stopped(world)
    assert world.state.x == pytest.approx(x, abs=0.2)


@pytest.mark.slow
def test_minutes_of_driving_about_raise_no_false_alarm(world: World) -> None:
    for i in range(30):
        world.hold((-1) ** i * 0.9, (i % 7 - 3) * 1.2, seconds=0.5 + i % 5 * 0.8, hz=10.0)
        world.send(0.0)
        world.run(0.2 + i % 3)
    assert "fault" not in {event.name for event in world.events}
