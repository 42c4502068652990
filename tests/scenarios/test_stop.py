"""A stop latches and brakes hard; deactivated or ending, the robot ramps down and obeys nobody."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import Config, McuConfig
from tests.each import each
from tests.scenarios.world import World, naming


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_a_stop_latches_until_clear_and_then_requires_neutral(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("stop").success
    world.hold(0.5, seconds=1.0)
    assert (world.state.mode, world.state.code) == ("stopped", "stopped")
    assert world.state.linear == 0.0
    assert world.call("clear").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "ready"
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"


def test_a_put_on_stop_stops_the_robot_with_any_payload(world: World) -> None:
    for payload in (b"", b"\x00", b"{}", b"please"):
        world.put("stop", payload)
        world.run(0.02)
        assert world.state.mode == "stopped"
        world.call("clear")


def test_a_delete_on_stop_is_not_a_stop(world: World) -> None:
    world.put("stop", b"", put=False)
    world.run(0.02)
    assert world.state.mode == "ready"


def test_a_deactivated_robot_ramps_down_and_ignores_commands(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("deactivate").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "inactive"
    assert world.state.linear == 0.0


RELEASE = b'{"release_port": true}'


def test_the_port_is_released_at_rest_until_the_next_activate() -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0")))
    world.drive(0.5, seconds=0.5)
    refused = world.call("deactivate", RELEASE)
    assert (refused.success, world.port.released) == (False, False)
    assert "while the robot rests" in refused.message
    world.hold(0.0, seconds=2.0)
    assert world.call("deactivate", RELEASE).success
    assert (world.state.mode, world.port.released) == ("inactive", True)
    assert world.call("activate").success
    assert (world.state.mode, world.port.released) == ("ready", False)


@each("before", ["stop", "deactivate"])
def test_the_port_of_a_robot_that_was_off_is_released_and_the_robot_stays_off(before: str) -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0")))
    world.run(1.0)
    world.call(before)
    world.run(1.0)
    mode, reply = world.state.mode, world.call("deactivate", RELEASE)
    assert (reply.success, reply.data.numbers, world.port.released) == (True, [], True)
    assert not world.call("activate", naming([])).success
    assert (world.state.mode, world.port.released) == (mode, False)


def test_the_simulator_built_in_has_no_port_to_release(world: World) -> None:
    assert not world.call("deactivate", RELEASE).success


def test_shutting_down_ramps_to_rest_and_obeys_no_client(world: World) -> None:
    world.drive(0.9, seconds=2.0)
    world.loop.shutting_down = True
    world.hold(0.9, seconds=0.35)
    assert world.loop.at_rest
    assert world.state.mode == "shutdown"
    assert not world.call("activate").success
