"""An export says what was said: message for message what the bus had while it was recorded."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.config.settings import Config
from acsard.messages.schema import DiagnosticArray, Events, Message, RobotState
from acsard.record.file import Recording
from acsard.record.published import MEASURED, Publisher
from acsard.record.replay import lived
from acsard.record.replayed import Course
from acsard.ros.channels import LOG
from acsard.ros.shapes import log
from tests.scenarios.taped import Tape, drive_through_faults, happenings
from tests.scenarios.world import World

CHECKED = replace(
    Config(),
    mcu=replace(Config().mcu, link_check="auto", encoder_counts=3200),
    odometry=replace(Config().odometry, gyro=True),
)

Said = dict[str, list[Any]]
"""Messages by the topic's name in the table, with its source."""


def driven(config: Config) -> tuple[World, Tape]:
    """A drive with faults and all that happens to a robot, and who listened to everything."""
    tape = Tape()
    world = World(config, recorder=tape)
    world.bus.publish("tf_static", world.loop.report.tf_static())
    drive_through_faults(world, 4.0)
    happenings(world, random.Random(1))
    world.call("set", b'{"settings": {"limits.max_linear_velocity": 0.4}}')
    world.drive(0.9, 0.2, 1.0)
    return world, tape


def exported(tape: Tape, config: Config, path: Path) -> Said:
    tape.write(path, config)
    recording = Recording(path)
    course = Course(recording)
    publisher, said = Publisher(course.robot, recording.about.started_ns), defaultdict(list)
    for step in course.steps():
        for one in publisher.step(step, lived(course.robot, step)):
            said[one.channel.native.replace("<source>", one.source)].append(one.message)
    assert course.trouble == ""
    return said


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(Config(), id="plain"),
        pytest.param(CHECKED, id="checked", marks=pytest.mark.slow),
    ],
)
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What was published, and what the export says."""
    world, tape = driven(request.param)
    path = tmp_path_factory.mktemp("export") / "drive.mcap"
    return world, tape, exported(tape, request.param, path)


def assert_same(then: Sequence[Message], now: Sequence[Message]) -> None:
    """Message for message; names the first that is another."""
    for number, (one, other) in enumerate(zip(then, now, strict=False)):
        assert one == other, f"message {number}"
    assert len(then) == len(now) > 0


@pytest.mark.parametrize("key", ["odom", "tf", "tf_static", "wheel_states", "cmd_vel_out"])
def test_every_message_is_the_one_that_was_published(key: str, both: Any) -> None:
    world, _, said = both
    assert_same(world.bus.published[key], said[key])


def test_every_state_is_the_same_but_for_what_the_daemon_measures_of_itself(both: Any) -> None:
    world, _, said = both
    then = [replace(one, figures={}) for one in world.bus.published["state"]]
    assert all(isinstance(one, RobotState) and one.counters["lines"] for one in then[20:])
    assert_same(then, said["state"])


def test_every_diagnostics_has_the_same_rows_but_those(both: Any) -> None:
    world, _, said = both
    left_out = MEASURED | {"acsard: recording"}
    then = [
        DiagnosticArray(one.header, [row for row in one.status if row.name not in left_out])
        for one in world.bus.published["diagnostics"]
    ]
    assert_same(then, said["diagnostics"])
    assert {row.name for row in then[-1].status} >= {"acsard: mode", "acsard: commands"}


def test_every_event_is_a_line_of_the_log(both: Any) -> None:
    world, _, said = both
    told: list[Any] = []
    for events in world.bus.published["events"]:
        assert isinstance(events, Events)
        told += events.events[len(events.events) - (events.total - len(told)) :]
    assert len(told) > 20
    lines = said[LOG.native]
    assert [(one.stamp, one.name) for one in told] == [(one.stamp, one.name) for one in lines]
    # `events` has what goes on and on in one row, with how often in all; the log a line each time.
    others = {
        one.name for one, line in zip(told, lines, strict=True) if log(one, line.stamp) != line
    }
    assert others <= {"lines_rejected", "missed_periods", "command_refused", "first_contact"}


def test_every_command_is_there_by_its_source_with_the_time_it_came(both: Any) -> None:
    _, tape, said = both
    offset_ns = {}
    heard: Said = defaultdict(list)
    for inputs, _, _ in tape.taken:
        offset_ns = inputs.now.wall_ns - inputs.now.mono_ns
        for one in inputs.commands:
            heard[f"cmd/{one.source}"].append(
                (one.arrived_ns + offset_ns, one.twist.linear, one.twist.angular)
            )
    assert set(heard) == {key for key in said if key.startswith("cmd/")} >= {"cmd/app"}
    for key, commands in heard.items():
        told = [(m.header.stamp.to_ns(), m.twist.linear.x, m.twist.angular.z) for m in said[key]]
        assert told == commands
