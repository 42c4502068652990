"""A robot gets another configuration in the middle of a replay.

The state derived from the configuration changes.
"""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.recording.state import adopt, freeze
from tests.scenarios.world import World

PLAIN = Config()


def driven() -> Robot:
    world = World()
    world.drive(0.5, 0.2, seconds=2.0)
    return world.loop.robot


def test_the_same_configuration_changes_nothing() -> None:
    robot = driven()
    before = freeze(robot, Memory())
    adopt(robot, Robot(PLAIN), Robot(PLAIN))
    assert freeze(robot, Memory()) == before


def test_configured_values_change_and_values_of_the_drive_stay() -> None:
    other = replace(
        PLAIN,
        drive=replace(PLAIN.drive, wheel_radius=0.1),
        limits=replace(PLAIN.limits, linear_speed=0.25),
    )
    robot = driven()
    pose, counters = robot.snapshot(0).pose, robot.counters.copy()
    adopt(robot, Robot(PLAIN), Robot(other))
    assert robot.snapshot(0).pose == pose
    assert robot.counters == counters
    assert robot.session.link == "up"
    assert vars(robot._kinematics) == vars(Robot(other)._kinematics)
    assert robot._kinematics is robot._odometry._kinematics


def test_a_part_that_the_state_lacks_comes_from_a_new_robot() -> None:
    robot = driven()
    del robot._answered
    adopt(robot, Robot(PLAIN), Robot(PLAIN))
    assert vars(robot._answered) == vars(Robot(PLAIN)._answered)
