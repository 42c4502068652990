"""The whole daemon, with a simulated board that reports its battery."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import BatteryConfig, Config, SimConfig
from acsard.core.messages.schema import Battery
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
