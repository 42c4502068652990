"""A fresh command does not wait for the next period, and adds no lines to those of the periods."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from acsard.core.config.settings import Config, McuConfig
from acsard.daemon.pacing import MAX_IDLE_WAKES
from tests.scenarios.world import World

MS = 1_000_000
GAP_NS = 3_864_583
"""The time of 33 bytes at 115200 baud, and a millisecond."""


@pytest.fixture
def world() -> World:
    made = World()
    made.run(0.2)
    made.send(0.0)
    made.run(0.05)
    return made


def sent_after(world: World, at_ns: int) -> list[int]:
    """Return the times in ns from `at_ns` to each line that the daemon has sent since then."""
    return [sent - at_ns for sent, _ in world.port.sent if sent >= at_ns]


def between_ticks(world: World, ms: float) -> None:
    """Run until `ms` after the start of the next control period."""
    world.run((world.next_period_ns - world.now_ns) / 1e9)
    world.run(ms / 1e3)


def test_a_fresh_command_is_sent_between_periods_without_delay(world: World) -> None:
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.send(0.5)
    assert sent_after(world, at_ns) == [0]
    assert world.port.sent[-1][1] != world.port.sent[-2][1]


def test_a_command_right_after_a_line_waits_for_the_minimum_gap_and_no_longer(world: World) -> None:
    between_ticks(world, 1.0)
    at_ns = world.now_ns
    world.send(0.5)
    world.run(0.008)
    assert sent_after(world, at_ns) == [GAP_NS - 1 * MS]


@pytest.mark.parametrize("hz", [30.0, 99.0, 333.0, 1000.0, 5000.0])
def test_no_rate_of_commands_makes_more_lines_than_periods(world: World, hz: float) -> None:
    at_ns = world.now_ns
    world.hold(0.5, seconds=1.0, hz=hz)
    lines = sent_after(world, at_ns)
    assert 99 <= len(lines) <= 102, "a hundred, and one more at either end"
    assert min(b - a for a, b in pairwise(lines)) >= GAP_NS


def test_a_stop_is_sent_between_periods_too(world: World) -> None:
    world.hold(0.5, seconds=1.0)
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.put("stop", b"")
    assert sent_after(world, at_ns) == [0]
    assert world.state.mode == "stopped"


def test_a_command_that_does_not_count_sends_no_early_line(world: World) -> None:
    world.hold(0.5, seconds=0.5, source="teleop")
    world.send(0.0, source="nav")
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    for _ in range(10):
        world.send(-0.5, source="nav")
        world.put("cmd/stranger", b"{}")
    world.run(0.0039)
    assert sent_after(world, at_ns) == []


def unplug(world: World) -> None:
    world.port.unplug()


def silence(world: World) -> None:
    world.mcu.muted = True


def block(world: World) -> None:
    world.port.blocked = True


@pytest.mark.parametrize("trouble", [unplug, silence, block])
def test_a_flood_that_no_line_can_answer_makes_few_steps(
    world: World, trouble: Callable[[World], None]
) -> None:
    world.hold(0.3, seconds=0.5, hz=1000.0)
    trouble(world)
    world.run(0.3)
    steps = world.steps
    world.hold(0.0, seconds=1.0, hz=1000.0)
    assert world.steps - steps <= 100 * (3 + MAX_IDLE_WAKES)


def test_the_reported_latencies_of_a_command_are_the_real_ones(world: World) -> None:
    between_ticks(world, 1.0)
    world.send(0.5)
    world.run(1.1)
    figures = world.state.latencies
    waited = figures["command_to_wire"].since_start
    assert waited.max == pytest.approx((GAP_NS - 1 * MS) / 1000)
    assert figures["mcu_round_trip"].since_start.count == 0, (
        "a plain reply does not name the line that it answers"
    )
    assert figures["period_lateness"].since_start.max == 0.0


def test_checked_replies_give_the_round_trip_time_of_the_microcontroller() -> None:
    world = World(Config(mcu=McuConfig(link_check="on")))
    world.run(1.0)
    round_trip = world.state.latencies["mcu_round_trip"].since_start
    assert round_trip.count > 50
    assert 6_700 <= round_trip.p50 <= 12_000
