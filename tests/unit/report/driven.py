"""Drives of the simulator, converted to a report's data for the tests of the report."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.replay import Replay
from acsard.recording.state import State
from acsard.report.report_data import ReportData
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


def report_of(
    drive: Callable[[World], None],
    begin: float = -math.inf,
    end: float = math.inf,
    config: Config | None = None,
) -> tuple[ReportData, list[RecordedStep]]:
    """Return the report's data of a drive, and the steps of the drive."""
    config, tape = config or Config(), Tape()
    world = World(config, recorder=tape)
    drive(world)
    steps = tape.steps()
    return report_from(steps, config, begin, end), steps


def report_from(
    steps: list[RecordedStep],
    config: Config | None = None,
    begin: float = -math.inf,
    end: float = math.inf,
    ending: str = "",
    state: State | None = None,
) -> ReportData:
    """Return a report's data for these steps and this end of the recording.

    `state` is the robot's state before the first step. It is None if the steps begin with the
    daemon's start.
    """
    config = config or Config()
    report, replay = ReportData(config, begin, end), Replay(*(state or (Robot(config),)))
    for step in steps:
        replay.step(step)
        assert replay.outputs is not None
        report.step(step, replay.outputs, replay.robot)
    report.end(ending)
    return report


def two_drivers(world: World) -> None:
    """Drive with the source nav, then with teleop. Stop and clear.

    At last a sender sends to an unknown source.
    """
    world.drive(0.5, 0.3, seconds=2.0, source="nav", hz=10.0)
    for n in range(40):
        world.send(0.5, 0.3, "nav")
        world.send(-0.3 if n else 0.0, -0.8 if n else 0.0, "teleop")
        world.run(0.05)
    world.call("stop")
    world.hold(0.3, seconds=0.5, source="teleop")
    world.call("clear")
    world.run(0.5)
    world.send(0.1, 0.0, "stranger")
    world.run(0.2)


@lru_cache
def drive_of_two() -> tuple[ReportData, list[RecordedStep]]:
    """Return the report's data and the steps of a drive with two sources.

    Tests must not change them.
    """
    return report_of(two_drivers)
