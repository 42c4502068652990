"""What arrives is taken or refused as a whole and counted, and `state` gives the reason."""

from __future__ import annotations

import pytest

from tests.scenarios.speakers import Speaker
from tests.scenarios.world import World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_stamps_that_zenoh_replaces_are_only_counted(world: World) -> None:
    client = Speaker(world, "signed", ahead=0.4)
    client.open()
    assert "stamps_replaced" not in world.state.counters
    ahead = Speaker(world, "signed", "b", ahead=3600.0)
    world.run(0.5)
    ahead.open()
    assert world.state.counters["stamps_replaced"] == 40


def test_state_is_published_ten_times_a_second_and_immediately_on_change(world: World) -> None:
    world.bus.wanted_keys.add("state")
    world.run(0.5)
    published = world.bus.published["state"]
    before = len(published)
    world.run(5.0)
    assert len(published) - before == 50
    before = len(published)
    world.put("stop", b"")
    world.run(0.012)
    assert len(published) - before >= 1


def test_commands_that_a_newer_one_follows_before_the_step_are_counted(world: World) -> None:
    """The newest command of each source is not counted as superseded."""
    world.send_together([0.1, 0.2, 0.3])
    world.send_together([0.4], source="teleop")
    world.run(0.1)
    assert world.state.counters["commands_superseded"] == 2
    world.send(0.1)
    world.run(0.1)
    assert world.state.counters["commands_superseded"] == 2


def test_after_a_stall_a_waiting_command_without_a_stamp_does_not_drive(world: World) -> None:
    """Its sender may have ended during the stall. A sender that still runs drives again."""
    world.drive(0.5, seconds=1.0)
    world.stall(0.9)
    before = world.mcu.vehicle.pose.x
    world.send(0.5)
    world.run(0.5)
    assert world.mcu.vehicle.pose.x == pytest.approx(before, abs=0.01)
    assert world.state.mode == "ready"
    world.hold(0.5, seconds=0.5)
    assert world.state.mode == "driving"
