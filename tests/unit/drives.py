"""Recorded drives that the tests of recordings share. A test changes none of them."""

from __future__ import annotations

from functools import cache

from acsard.core.config.settings import Config, SimConfig
from tests.scenarios.taped import BATCH, Tape, recorded_world

# The board reports its battery, so that each topic has messages.
CONFIG = Config(sim=SimConfig(faults=("battery=90:60",)))


@cache
def drive() -> Tape:
    """Return a drive of app and teleop that ends with a stop, with the robot's states."""
    tape, world = recorded_world(CONFIG, every=BATCH)
    world.drive(0.5, 0.3, 2.0)
    world.drive(0.3, 0.0, 0.3, source="teleop")
    world.call("stop")
    world.port.blocked = True  # lines that do not leave
    world.run(0.05)
    world.port.blocked = False
    world.run(1.0)
    return tape
