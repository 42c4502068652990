"""Who drives: senders that a zero of their own has armed, and of these the highest source."""

from __future__ import annotations

import random
from typing import get_args

import pytest

from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Speaker, Way, moved
from tests.scenarios.world import World


def quiet() -> World:
    world = World()
    world.run(0.3)
    return world


@pytest.mark.slow
@pytest.mark.parametrize("way", get_args(Way))
def test_the_zeros_of_one_program_never_arm_another(way: Way) -> None:
    """One client sends only zeros and another one only speeds, and the robot stays at rest.

    Before this rule the robot moved 2.1 m in 5 s.
    """
    for seed in range(2):
        dice = random.Random(seed)
        world = quiet()
        zeros, speeds = Speaker(world, way, "zeros"), Speaker(world, way, "speeds")
        zero_hz, speed_hz = dice.choice((5.0, 10.0, 30.0)), dice.choice((10.0, 20.0, 50.0))
        due = [dice.uniform(0.0, 0.5), dice.uniform(0.0, 0.5)]
        start_ns = world.now_ns
        while min(due) < 5.0:
            number = due.index(min(due))
            at_ns = start_ns + int(due[number] * 1e9)
            world.run(max(0.0, (at_ns - world.now_ns) / 1e9))
            (zeros, speeds)[number].send((0.0, 0.5)[number])
            due[number] += 1 / (zero_hz, speed_hz)[number] * dice.uniform(0.9, 1.1)
        assert not moved(world, start_ns), seed


def test_two_programs_with_a_gid_of_zeros_never_arm_each_other() -> None:
    """Without this rule, they drove the robot by 2.18 m."""
    world = quiet()
    one, other = (Speaker(world, "rmw", "\0" * 16) for _ in range(2))
    since_ns = world.now_ns
    for number in range(100):
        other.send(0.4)
        world.run(0.02)
        if number % 10 == 5:
            one.send(0.0)
        world.run(0.03)
    assert not moved(world, since_ns)


# neutral_first = "pause"


def navigating(way: Way, name: str = "nav2") -> tuple[World, Speaker]:
    """Return a world in which a pause counts, and a sender to the source `nav`."""
    world = World()
    world.run(6.5)
    speaker = Speaker(world, way, name)
    speaker.key = "cmd/nav"
    return world, speaker


@pytest.mark.variations(3)
@pytest.mark.parametrize("event", ["clear", "deactivate", "link", "reset", "restart", "stall"])
def test_where_a_pause_arms_a_goal_under_way_does_not_drive_after_an_event(event: str) -> None:
    world, nav = navigating("rmw")
    if event == "restart":
        world = World()
        nav.world = world
        for _ in range(240):  # until the network of the robot is up
            nav.message(0.4)
            world.run(0.05)
    else:
        nav.hold(0.4, 1.0)
    match event:
        case "clear":
            world.call("stop")
            nav.hold(0.4, 2.2)
            assert world.call("clear").success
        case "deactivate":
            world.call("deactivate")
            nav.hold(0.4, 2.2)
            assert world.call("activate").success
        case "link":
            mcu = world.mcu
            world.port.unplug()
            nav.hold(0.4, 1.5)
            world.port.plug(mcu)
        case "reset":
            world.mcu.reset(world.now_ns)
            nav.hold(0.4, 1.5)
        case "stall":
            # The goal begins in a second that the daemon has not watched.
            nav.hold(0.0, 0.2)
            world.run(12.0)
            world.stall(1.2)
            nav.message(0.4)
    since_ns = world.now_ns + NS_PER_S // 2 * (event in ("clear", "deactivate"))
    nav.hold(0.4, 3.0)
    assert not moved(world, since_ns)
    assert world.state.code == "neutral", world.state.reason
    nav.send(0.0)  # the goal is cancelled, and sent again
    world.run(1.1)
    nav.hold(0.4, 0.5)
    assert world.state.mode == "driving"


# Of several sources the highest drives; of several senders of one source, the first


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
    assert waits_for(world, "app").startswith(
        "1 other sender of this source must wait until the sender that drives falls silent"
    )
    second.hold(-0.4, 2.0)
    assert world.state.linear == pytest.approx(-0.4, abs=0.03)
    assert waits_for(world, "app") == ""
