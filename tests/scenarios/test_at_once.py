"""A fresh command does not wait for the clock; the clock's lines stay as many as they were."""

from __future__ import annotations

from itertools import pairwise

import pytest

from acsard.settings import CommandsConfig, Config, Source
from tests.scenarios.world import World

MS = 1_000_000
GAP_NS = 3_864_583
"""33 bytes at 115200 baud and a millisecond."""


@pytest.fixture
def world() -> World:
    made = World()
    made.run(0.2)
    made.send(0.0)
    made.run(0.05)
    return made


def sent_after(world: World, at_ns: int) -> list[int]:
    """When lines left since `at_ns`, in ns after it."""
    return [sent - at_ns for sent, _ in world.port.sent if sent >= at_ns]


def between_ticks(world: World, ms: float) -> None:
    """Go on to so many ms after a tick."""
    world.run((world.next_tick_ns - world.now_ns) / 1e9)
    world.run(ms / 1e3)


def test_a_fresh_command_is_on_the_wire_at_once(world: World) -> None:
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.send(0.5)
    assert sent_after(world, at_ns) == [0]
    assert world.state.linear >= 0.0


def test_one_that_comes_right_after_a_line_waits_for_the_gap_and_no_longer(world: World) -> None:
    between_ticks(world, 1.0)
    at_ns = world.now_ns
    world.send(0.5)
    world.run(0.008)
    assert sent_after(world, at_ns) == [GAP_NS - 1 * MS]


def test_it_takes_the_place_of_the_next_periods_line(world: World) -> None:
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.send(0.5)
    world.run(0.0239)
    assert sent_after(world, at_ns) == [0, 14 * MS]


@pytest.mark.parametrize("hz", [30.0, 99.0, 333.0, 1000.0, 5000.0])
def test_however_often_commands_come_there_are_no_more_lines_than_periods(
    world: World, hz: float
) -> None:
    at_ns = world.now_ns
    world.hold(0.5, seconds=1.0, hz=hz)
    lines = sent_after(world, at_ns)
    assert 99 <= len(lines) <= 102, "a hundred, and one more at either end"
    assert min(b - a for a, b in pairwise(lines)) >= GAP_NS


def test_a_stop_goes_at_once_too(world: World) -> None:
    world.hold(0.5, seconds=1.0)
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.put("stop", b"")
    assert sent_after(world, at_ns) == [0]
    assert world.state.mode == "stopped"


def test_one_whose_command_does_not_count_pulls_no_line_forward(world: World) -> None:
    world.hold(0.5, seconds=0.5, source="teleop")
    world.send(0.0, source="nav")
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    for _ in range(10):
        world.send(-0.5, source="nav")
        world.put("cmd/stranger", b"{}")
    world.run(0.0039)
    assert sent_after(world, at_ns) == []


def test_a_ramp_is_as_steep_under_a_flood_as_without(world: World) -> None:
    calm = World()
    calm.run(0.25)
    for one, hz in ((calm, 10.0), (world, 1000.0)):
        one.send(0.0)
        one.run(0.05)
        began_ns = one.now_ns
        one.hold(1.0, seconds=0.5, hz=hz)
        speed = one.loop.robot._limiter.twist.linear
        assert speed == pytest.approx((one.now_ns - began_ns) / 1e9, abs=0.025)


def test_a_repeated_command_keeps_a_robot_from_stopping_but_makes_no_line_of_its_own() -> None:
    world = World(Config(commands=CommandsConfig(sources=(Source("app", 1, 0.02),))))
    world.run(0.2)
    world.drive(0.3, seconds=1.0, hz=200.0)
    assert world.state.mode == "driving"


def test_what_the_daemon_says_of_itself_is_what_happened(world: World) -> None:
    between_ticks(world, 1.0)
    world.send(0.5)
    world.run(1.1)
    figures = world.state.figures
    waited = figures["command_to_wire"].since_start
    assert waited.count == 2
    assert waited.max == pytest.approx(GAP_NS / 1000)
    assert waited.p50 == pytest.approx((GAP_NS - 1 * MS) / 1000, rel=0.13)
    round_trip = figures["mcu_round_trip"].since_start
    assert 6_700 <= round_trip.p50 <= 10_700
    assert figures["period_lateness"].since_start.max == 0.0
