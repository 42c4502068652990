"""A fresh command does not wait for the next period, and adds no lines to those of the periods."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import CommandsConfig, Config, McuConfig, Source
from acsard.core.incoming.queries import Query
from acsard.daemon.pacing import MAX_IDLE_WAKES
from tests.scenarios.world import World
from tests.stepped import Outputs

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


def test_an_early_line_replaces_the_line_of_the_next_period(world: World) -> None:
    between_ticks(world, 6.0)
    at_ns = world.now_ns
    world.send(0.5)
    world.run(0.0239)
    assert sent_after(world, at_ns) == [0, 14 * MS]


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


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.floats(0.0005, 0.06),
            st.sampled_from(["app", "teleop", "stop", "block", "stall", "deactivate"]),
            st.floats(-1.0, 1.0),
        ),
        max_size=40,
    )
)
@settings(max_examples=25)
def test_no_timing_of_commands_makes_a_ramp_steeper_or_steps_more(
    happenings: list[tuple[float, str, float]],
) -> None:
    world = World()
    world.run(0.3)
    for _ in range(2):
        world.send(0.0)
        world.send(0.0, source="teleop")
        world.run(0.05)
    steps, began_ns, good_lines = world.steps, world.now_ns, world.loop.robot.session.good_lines
    lines: list[tuple[int, float]] = []

    def watch(outputs: Outputs) -> None:
        if world.port.sent and (not lines or world.port.sent[-1][0] > lines[-1][0]):
            lines.append((world.port.sent[-1][0], abs(outputs.speeds.front_left) * 0.05))

    world.watch = watch
    for wait, what, value in happenings:
        world.port.blocked = what == "block"
        if what in ("app", "teleop"):
            world.send(value, source=what)
        elif what == "stop":
            world.put("stop", b"")
        elif what == "stall":
            world.stall(abs(value) / 10)
        elif what == "deactivate":
            world.ask("srv/deactivate")
        world.run(wait)
    for (before_ns, slower), (after_ns, faster) in pairwise(lines):
        # A stall is made up for by at most MAX_DT; a line rounds to 0.01 rad/s.
        assert faster - slower <= min(after_ns - before_ns, 50 * MS) * 1e-9 + 1e-3
    periods = (world.now_ns - began_ns) / (10 * MS)
    good_lines = world.loop.robot.session.good_lines - good_lines
    assert world.steps - steps <= (5 + MAX_IDLE_WAKES) * (periods + 1) + good_lines + len(
        happenings
    )


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


def test_after_a_stall_the_periodic_line_is_sent_even_after_an_early_line(world: World) -> None:
    between_ticks(world, 6.0)
    world.send(0.5)
    world.stall(0.045)
    at_ns = world.now_ns
    world.run(0.001)
    assert sent_after(world, at_ns) == [0]


def test_a_request_that_makes_the_robot_brake_is_sent_even_after_an_early_line(
    world: World,
) -> None:
    world.hold(0.5, seconds=1.0)
    between_ticks(world, 5.0)
    world.send(0.5)
    world.run(0.001)
    query = Query(77, "srv/deactivate", "srv/deactivate", "", b"", "", world.now_ns)
    world.bus.queries.append(query)
    at_ns = world.now_ns
    world.run(0.0045)
    assert world.state.mode == "inactive"
    assert sent_after(world, at_ns) == [4 * MS]


@pytest.mark.variations(12)
@pytest.mark.parametrize("phase_ms", [0.0, 1.7, 3.1, 4.9, 6.3, 8.8, 9.6])
@pytest.mark.parametrize("apart_ms", [0.6, 2.2, 5.1, 9.4])
def test_when_two_commanders_die_together_braking_starts_a_tick_after_the_timeout(
    phase_ms: float, apart_ms: float
) -> None:
    world = World()
    world.run(0.3)
    for source in ("teleop", "nav"):
        world.send(0.0, source=source)
    world.run(0.05)
    for source in ("teleop", "nav") * 20:
        world.send(0.5, source=source)
        world.run(0.025)
    between_ticks(world, phase_ms)
    world.send(0.5, source="teleop")
    world.run(apart_ms / 1e3)
    world.send(0.5, source="nav")
    last_ns = world.now_ns
    world.run(0.4)
    full = max(at for at, line in world.port.sent if line.startswith(b"ap10.00"))
    slower = min(at for at, line in world.port.sent if at > full)
    assert slower - last_ns <= 260 * MS


def test_a_repeated_command_keeps_a_robot_from_stopping_but_makes_no_line_of_its_own() -> None:
    world = World(Config(commands=CommandsConfig(sources=(Source("app", 1, 0.02),))))
    world.run(0.2)
    world.drive(0.3, seconds=1.0, hz=200.0)
    assert world.state.mode == "driving"


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
