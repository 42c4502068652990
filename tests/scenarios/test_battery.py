"""The whole daemon, with a simulated board that reports its battery."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import BatteryConfig, Config, SimConfig
from acsard.core.messages.schema import Battery, RobotState
from tests.scenarios.taped import Tape, replayed
from tests.scenarios.world import World

LEVELS = BatteryConfig("percent", warning_below=50.0, stop_below=10.0)
DRAINED = Config(battery=LEVELS, sim=SimConfig(faults=("battery=60:2",)))
"""A robot with a small battery: at rest, a full one lasts two minutes."""


def level(world: World) -> str:
    assert world.state.battery is not None
    return world.state.battery.level


@pytest.mark.slow
def test_a_drained_battery_warns_and_then_stops_the_robot_until_it_is_charged() -> None:
    world = World(DRAINED)
    world.run(0.3)
    assert level(world) == "unknown"
    levels: list[tuple[str, str]] = []
    world.drive(0.3, seconds=0.5)
    for _ in range(300):
        world.hold(0.3, seconds=0.2)
        if (level(world), world.state.mode) not in levels:
            levels.append((level(world), world.state.mode))
    assert levels == [
        ("unknown", "driving"),
        ("ok", "driving"),
        ("warning", "driving"),
        ("stop", "stopped"),
    ]
    assert world.state.code == "battery_empty"
    refused = world.call("clear")
    assert not refused.success
    assert refused.message == (
        "battery below battery.stop_below = 10 %: charge the battery to 10.5 %, then call "
        "srv/clear again"
    )
    with world.mcu.battery(90.0, 60.0):
        world.run(30.0)
        assert (level(world), world.state.mode) == ("ok", "stopped")
        assert world.call("clear").success
        world.drive(0.3, seconds=0.5)
        assert world.state.mode == "driving"


@pytest.mark.slow
def test_the_simulated_battery_drops_by_two_volts_when_the_motors_start() -> None:
    config = Config(
        battery=BatteryConfig(warning_below=23.0), sim=SimConfig(faults=("battery=60:600",))
    )
    world = World(config)
    world.run(5.0)
    volts: list[float] = []

    def look(state: RobotState) -> None:
        assert state.battery is not None
        assert state.battery.level == "ok"
        assert state.battery.volts is not None
        volts.append(state.battery.volts)

    look(world.state)
    world.drive(0.5, seconds=0.05)
    for _ in range(40):
        world.hold(0.5, seconds=0.05)
        look(world.state)
    assert max(volts) - min(volts) > 2.0
    # The mean stays above 23 V although the voltage falls to 21 V.
    assert min(volts) < 21.5


def test_the_battery_key_has_the_battery_about_once_a_second() -> None:
    world = World(DRAINED, wanted=frozenset({"battery"}))
    world.run(5.0)
    messages = world.bus.published["battery"]
    assert 5 <= len(messages) <= 7
    last = messages[-1]
    assert isinstance(last, Battery)
    assert (last.present, last.power_supply_status) == (True, 2)
    assert last.current == -0.5
    assert last.percentage == 0.57


@pytest.mark.slow
def test_a_recording_replays_a_battery_that_runs_empty() -> None:
    tape = Tape()
    world = World(DRAINED, recorder=tape)
    world.drive(0.3, seconds=20.0)
    middle, tape.cut = len(tape.taken) + 1, True
    world.drive(0.3, seconds=20.0)
    world.call("clear")
    with world.mcu.battery(90.0, 60.0):
        world.run(20.0)
        world.call("clear")
        world.drive(0.3, seconds=1.0)
    assert {"driving", "stopped", "ready"} <= {step.status.mode for step in tape.taken}
    for first in (0, middle):
        comparison = replayed(tape, DRAINED, first).comparison
        assert comparison.first is None
        assert comparison.steps == len(tape.taken) - first
