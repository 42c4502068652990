"""What a planner with gaps and a worn stick send is shown as it was measured."""

from __future__ import annotations

import pytest

from acsard.core.messages.schema import DiagnosticArray, SourceState
from tests.each import each
from tests.scenarios.world import World


def source(world: World, name: str) -> SourceState:
    return next(s for s in world.state.sources if s.name == name)


def codes(world: World) -> list[str]:
    message = world.loop.publication.current("diagnostics")
    assert isinstance(message, DiagnosticArray)
    (row,) = [row for row in message.status if row.name == "acsard: commands"]
    return [row.message, *[pair.value for pair in row.values if pair.key == "code"]]


@each(("gap_s", "warned"), [(0.2, False), (0.3, True), (0.9, True)])
def test_the_longest_gap_between_commands_is_shown_for_half_a_minute(
    gap_s: float, warned: bool
) -> None:
    world = World()
    world.run(0.5)
    for _ in range(3):
        world.drive(0.3, 0.0, 0.5, source="nav")
        world.run(gap_s)
    world.drive(0.3, 0.0, 0.5, source="nav")
    assert source(world, "nav").longest_gap == pytest.approx(gap_s, abs=0.06)
    assert (codes(world)[1] == "command_gaps") is warned
    assert source(world, "teleop").longest_gap == 0.0


def test_a_pause_behind_a_zero_and_the_end_of_a_drive_are_no_gaps() -> None:
    world = World()
    world.run(0.5)
    world.drive(0.3, 0.0, 0.5, source="nav")
    world.drive(0.0, 0.0, 0.2, source="nav")
    world.run(2.0)
    world.drive(0.3, 0.0, 0.5, source="nav")
    world.run(6.0)
    world.drive(0.3, 0.0, 0.5, source="nav")
    assert source(world, "nav").longest_gap < 0.1
    assert codes(world)[1] != "command_gaps"


def test_a_stick_that_never_sends_zero_is_named_with_what_it_sends() -> None:
    world = World()
    world.run(0.5)
    world.hold(0.004, -0.006, 3.5, source="teleop")
    stick = source(world, "teleop")
    assert (stick.wait, stick.linear, stick.angular) == ("neutral", 0.004, -0.006)
    message, code = codes(world)
    assert code == "never_zero"
    assert "0.004 m/s and -0.006 rad/s" in message
    assert "commanded by" not in message
