"""Of several sources the highest drives; of several senders of one source, the first."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import CommandsConfig, Config, Source
from tests.scenarios.speakers import Speaker, Way
from tests.scenarios.world import World


def waits_for(world: World, source: str) -> str:
    return {s.name: s.waits_for for s in world.state.sources}[source]


def test_the_higher_priority_takes_the_robot_and_gives_it_back() -> None:
    world = World()
    world.run(0.2)
    world.send(0.0, source="nav")
    world.send(0.0, source="teleop")
    world.run(0.05)
    for _ in range(20):
        world.send(0.2, source="nav")
        world.send(-0.2, source="teleop")
        world.run(0.05)
    assert (world.state.source, world.odom.twist.twist.linear.x < 0) == ("teleop", True)
    assert "teleop has priority" in waits_for(world, "nav")
    world.hold(0.2, seconds=1.0, source="nav")
    assert (world.state.source, world.odom.twist.twist.linear.x > 0) == ("nav", True)


def test_at_equal_priority_the_first_keeps_the_robot() -> None:
    pair = (Source("left", 50), Source("right", 50))
    world = World(Config(commands=CommandsConfig(sources=pair)))
    world.run(0.2)
    world.drive(0.3, seconds=0.2, source="right")
    world.send(0.0, source="left")
    for _ in range(10):
        world.send(-0.3, source="left")
        world.send(0.3, source="right")
        world.run(0.05)
    assert world.state.source == "right"
    assert "came first" in waits_for(world, "left")


@pytest.mark.parametrize("way", ["client", "signed", "rmw"])
def test_only_the_first_of_two_senders_on_a_key_is_obeyed_and_the_second_is_reported(
    way: Way,
) -> None:
    world = World()
    world.run(0.2)
    first, second = Speaker(world, way, "a"), Speaker(world, way, "b")
    for speaker in (first, second):
        speaker.hold(0.0, 1.0)
    world.run(1.1)
    for _ in range(40):
        first.send(0.4)
        world.run(0.025)
        second.send(-0.4)
        world.run(0.025)
        assert world.odom.twist.twist.linear.x >= 0.0
    assert world.state.linear == pytest.approx(0.4, abs=0.03)
    assert (
        waits_for(world, "app")
        == "1 other sender of this source must wait until the sender that drives falls silent"
    )
    second.hold(-0.4, 2.0)
    assert world.state.linear == pytest.approx(-0.4, abs=0.03)
    assert waits_for(world, "app") == ""
