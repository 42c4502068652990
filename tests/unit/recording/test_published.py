"""Tests of the messages that a replayed robot publishes.

`scenarios/test_export.py` proves that they equal the original messages.
"""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.messages.schema import Time
from acsard.core.robot import Robot
from acsard.recording.published import MEASURED_ROWS, Published, Publisher
from acsard.recording.stepped_robot import SteppedRobot
from acsard.recording.timeline import TimelineWriter
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World


def published_messages(tape: Tape, config: Config) -> list[Published]:
    robot = SteppedRobot(Robot(config))
    publisher = Publisher(robot.robot, START.wall_ns)
    return [m for step in tape.steps() for m in publisher.step(step, robot.step(step.inputs))]


def names(published: list[Published]) -> set[str]:
    return {message.channel.name for message in published}


def driven() -> Tape:
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.4, 1.0)
    return tape


def test_a_transform_that_is_switched_off_is_not_published() -> None:
    tape, config = driven(), Config()
    quiet = replace(
        config,
        odometry=replace(config.odometry, publish_tf=False),
        lidar=replace(config.lidar, publish_tf=False),
    )
    assert names(published_messages(tape, config)) - names(published_messages(tape, quiet)) == {
        "tf",
        "tf_static",
    }


def test_other_parameters_change_the_pose_but_not_the_received_commands() -> None:
    tape, config = driven(), Config()
    wider = replace(config, drive=replace(config.drive, wheel_separation=0.6))
    then, now = published_messages(tape, config), published_messages(tape, wider)
    (last, other) = (
        [m for m in messages if m.channel.name == "odom"][-1] for messages in (then, now)
    )
    turned, less = (m.message.pose.pose.orientation.z for m in (last, other))
    assert 0.3 < less / turned < 0.7
    commands = [
        [m for m in messages if m.channel.name.startswith("cmd_vel_in")] for messages in (then, now)
    ]
    assert commands[0] == commands[1] != []


def test_odometry_is_published_after_its_sample_and_a_command_at_its_arrival() -> None:
    published = published_messages(driven(), Config())
    odom = [m for m in published if m.channel.name == "odom"]
    assert all(m.message.header.stamp.to_ns() <= m.wall_ns for m in odom)
    times = [m.wall_ns for m in odom]
    assert times == sorted(times)
    commands = [m for m in published if m.source == "app"]
    assert all(m.message.header.stamp.to_ns() == m.wall_ns for m in commands)


def test_values_that_a_recording_lacks_are_not_published() -> None:
    published = published_messages(driven(), Config())
    rows = {
        row.name for m in published if m.channel.name == "diagnostics" for row in m.message.status
    }
    assert rows
    assert not rows & MEASURED_ROWS
    states = [m.message for m in published if m.channel.name == "state"]
    assert all(state.latencies == {} and state.certificate_expiry == "" for state in states)


@pytest.mark.slow
def test_the_log_has_the_same_lines_as_the_timeline() -> None:
    tape = driven()
    timeline, steps = TimelineWriter(Config()), tape.steps()
    entries = [entry for step in steps for entry in timeline.step(step)]
    lines = [m for m in published_messages(tape, Config()) if m.channel.name == "log"]
    assert [line.message.name for line in lines] == [entry.name for entry in entries]
    assert [line.message.msg for line in lines] == [entry.sentence for entry in entries]
    assert "start" in [line.message.name for line in lines]


def test_the_lines_after_the_last_step_have_the_drive_and_the_ending() -> None:
    tape, robot = driven(), SteppedRobot(Robot(Config()))
    publisher = Publisher(robot.robot, START.wall_ns)
    for step in tape.steps():
        list(publisher.step(step, robot.step(step.inputs)))
    drive, cut = [line.message for line in publisher.end("the disk accepted no more data")]
    assert (drive.name, drive.msg[:13]) == ("drive", "was driving, ")
    assert (cut.name, cut.msg, cut.level) == ("cut", "the disk accepted no more data", 30)
    assert drive.stamp == cut.stamp == Time.from_ns(tape.taken[-1].inputs.now.wall_ns)
