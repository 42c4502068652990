"""A person with rqt_robot_monitor sees the robot's condition while it runs."""

from __future__ import annotations

import pytest

from acsard.core.messages.schema import DiagnosticArray, DiagnosticStatus
from tests.scenarios.speakers import Speaker, Way
from tests.scenarios.world import World

OK, WARN = 0, 1


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def row(world: World, name: str) -> DiagnosticStatus:
    message = world.loop.publication.current("diagnostics")
    assert isinstance(message, DiagnosticArray)
    (row_status,) = [status for status in message.status if status.name == f"acsard: {name}"]
    return row_status


@pytest.mark.slow
def test_a_source_is_a_warning_while_it_is_refused(world: World) -> None:
    world.drive(0.3, seconds=0.5)
    assert row(world, "commands").level == OK
    for _ in range(30):
        world.send(0.3, source="nobody")
        world.hold(0.3, seconds=0.1)
        assert row(world, "commands").level == WARN
    assert "source nobody: this source is not in commands.sources" in row(world, "commands").message
    world.hold(0.3, seconds=2.0)
    assert (row(world, "commands").level, world.state.source) == (OK, "app")


@pytest.mark.parametrize("way", ["client", "rmw"])
def test_a_second_program_on_a_source_is_a_warning_until_one_of_them_is_silent(
    world: World, way: Way
) -> None:
    first, second = Speaker(world, way, "first"), Speaker(world, way, "second")
    first.open()
    assert row(world, "commands").level == OK
    for _ in range(20):
        first.send(0.4)
        second.send(0.0)
        world.run(0.05)
    status = row(world, "commands")
    assert status.level == WARN
    assert "2 programs send as app" in status.message
    second.hold(0.0, 1.0)
    assert row(world, "commands").level == OK


@pytest.mark.slow
def test_missed_periods_are_a_warning_for_a_minute(world: World) -> None:
    assert row(world, "control loop").level == OK
    for _ in range(20):
        world.stall(0.05)
        world.run(0.05)
    assert row(world, "control loop").level == WARN
    world.run(61.0)
    status = row(world, "control loop")
    assert status.level == OK
    assert status.message.startswith("0 of ")
    assert world.state.counters["missed_periods"] > 60
