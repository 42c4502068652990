"""Each field of `state` tells something: some robot gives it another value than its default."""

from __future__ import annotations

from collections.abc import Iterator

from msgspec import NODEFAULT
from msgspec.structs import fields

from acsard.core.config.settings import (
    BatteryConfig,
    Config,
    McuConfig,
    OdometryConfig,
    SafetyConfig,
    SimConfig,
)
from acsard.core.messages.schema import RobotState
from tests.scenarios.world import World

# What only a daemon with files has.
OF_FILES = {
    "recording_error", "latch_file_error", "certificate", "certificate_expiry", "certificate_days",
}  # fmt: skip


def states() -> Iterator[RobotState]:
    """Yield the states of robots in different situations."""
    coarse = World(Config(sim=SimConfig(encoder_counts=20)))
    coarse.run(0.2)
    coarse.drive(0.4, seconds=6.0)
    yield coarse.state
    faults = "estop", "bumpers", "battery=80:600"
    world = World(
        Config(
            mcu=McuConfig(encoder_counts=3200, link_check="on"),
            odometry=OdometryConfig(gyro=True),
            safety=SafetyConfig(estop="required", bumpers=("front", "rear")),
            battery=BatteryConfig(stop_below=10.0),
            sim=SimConfig(encoder_counts=3200, faults=faults),
        )
    )
    world.run(1.0)
    yield world.state
    world.drive(0.3, 0.2, seconds=2.0)
    yield world.state
    world.put("speed_limit", b'{"speed_limit": 0.1, "percentage": false}')
    world.send(0.3, source="nobody")
    with world.mcu.fault("stuck_encoder", 1):
        world.hold(0.3, seconds=2.0)
    yield world.state
    world.call("set", b'{"settings": {"limits.linear_speed": 0.4}}')
    with world.mcu.fault("mute"):
        world.run(1.0)
        yield world.state
    world.call("stop")
    world.run(0.5)
    yield world.state


def test_some_robot_gives_each_field_of_its_state_another_value_than_the_default() -> None:
    seen, same = list(states()), set[str]()
    for field in fields(RobotState):
        values = [getattr(state, field.name) for state in seen]
        default = values[0] if field.default is NODEFAULT else field.default
        if field.default_factory is not NODEFAULT:
            default = field.default_factory()
        if all(value == default for value in values):
            same.add(field.name)
    always = same - OF_FILES
    assert not always, f"core/summary.py or daemon/publication.py never fills in {always}"
    assert not OF_FILES - same, f"filled in: remove {OF_FILES - same} from OF_FILES"
