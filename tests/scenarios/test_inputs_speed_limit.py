"""Nav2's speed filter limits the robot in a zone, while an operator changes the limits too."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from acsard.core.config.settings import Config
from tests.each import each
from tests.scenarios.test_restart import MemoryFile
from tests.scenarios.test_settings import config, sets
from tests.scenarios.world import START, World
from tests.stepped import Outputs


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def limit(world: World, value: float, **fields: Any) -> None:
    world.put("speed_limit", msgspec.json.encode({"speed_limit": value} | fields))
    world.run(0.15)


def fastest(world: World) -> list[float]:
    """Return a list to which each later step adds its linear speed in m/s, without its sign."""
    speeds: list[float] = []

    def note(outputs: Outputs) -> None:
        speeds.append(abs(outputs.applied.linear))

    world.watch = note
    return speeds


@pytest.mark.slow
def test_a_zone_slows_the_robot_and_its_end_lets_it_go_on_as_before(world: World) -> None:
    world.drive(0.8, seconds=2.0)
    limit(world, 25.0, percentage=True)
    world.hold(0.8, seconds=1.5)
    assert world.state.linear == pytest.approx(0.25, abs=0.02)
    assert world.state.speed_limit.startswith("0.25 m/s, set by ")
    (reply,) = world.ask("diagnostics")
    assert f"speed limit: {world.state.speed_limit}".encode() in reply.payload
    limit(world, 0.0)
    world.hold(0.8, seconds=1.5)
    assert world.state.linear == pytest.approx(0.8, abs=0.02)
    assert (world.state.speed_limit, config(world)) == ("", Config())
    events = [event for event in world.events if event.name == "speed_limit"]
    assert [event.text for event in events] == ["0.25 m/s", "the speed limit has ended"]
    assert all(event.by.endswith(" on the key speed_limit") for event in events)


@pytest.mark.slow
@each("first", ["limit", "set"])
@each("value", [0.2, 0.5])
def test_the_lower_of_a_speed_limit_and_a_setting_wins_in_either_order(
    first: str, value: float
) -> None:
    world = World()
    world.run(0.2)
    if first == "limit":
        limit(world, value)
        assert sets(world, limits__linear_speed=0.3).success
    else:
        assert sets(world, limits__linear_speed=0.3).success
        limit(world, value)
    speeds = fastest(world)
    world.drive(1.0, seconds=1.5)
    assert max(speeds) == pytest.approx(min(value, 0.3))
    limit(world, 0.0)
    speeds = fastest(world)
    world.hold(1.0, seconds=1.5)
    assert max(speeds) == pytest.approx(0.3)


def test_a_speed_limit_neither_moves_the_robot_nor_clears_a_stop(world: World) -> None:
    assert world.call("stop").success
    limit(world, 0.3)
    limit(world, 0.0)
    assert world.state.mode == "stopped"
    assert world.newest
    assert world.state.sources[0].age is None


def test_a_restart_forgets_the_limit_and_the_latch_file_never_has_it() -> None:
    """A restart removes the speed filter's limit, because no program may be left to lift it."""
    file = MemoryFile()
    world = World(keeper=file, latches=file.latches)
    world.run(0.2)
    limit(world, 0.2)
    assert world.state.speed_limit
    assert file.data == b""
    assert world.call("stop").success
    again = World(latches=file.read(START), keeper=file)
    again.run(0.2)
    assert again.state.speed_limit == ""


def test_a_percentage_is_a_share_of_the_configured_speed(world: World) -> None:
    assert sets(world, limits__linear_speed=0.6).success
    limit(world, 50.0, percentage=True)
    assert world.state.speed_limit.startswith("0.5 m/s, ")
