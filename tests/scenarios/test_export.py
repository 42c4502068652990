"""An export contains exactly the messages that the bus had during the recording.

The exported file is compared byte by byte; `unit/recording/test_export.py` decodes it by another
library.
"""

from __future__ import annotations

import random
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import SeekingReader
from msgspec.structs import replace

from acsard.core.config.settings import Config, SimConfig
from acsard.core.messages.schema import (
    Battery,
    DiagnosticArray,
    Events,
    Header,
    Message,
    RobotState,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.ros.channels import BY_KEY, CHANNELS, CMD_VEL_IN, LOG_CHANNEL, state
from acsard.core.ros.shapes import log
from acsard.recording.export import export
from acsard.recording.file import Recording
from acsard.recording.published import MEASURED_ROWS
from tests.scenarios.taped import (
    ADDED,
    Tape,
    drive_through_faults,
    happenings,
    recorded_world,
)
from tests.scenarios.world import EVERY_KEY, World

PLAIN = Config(sim=SimConfig(faults=("battery=90:60",)))
"""A robot whose board reports its battery, so that each topic has messages."""

CHECKED = replace(
    PLAIN,
    mcu=replace(Config().mcu, link_check="on", encoder_counts=3200),
    odometry=replace(Config().odometry, gyro=True),
)

Said = dict[str, list[Any]]
"""Messages by the topic's name in the table, with its source."""


def driven(config: Config) -> tuple[World, Tape]:
    """Drive with faults and all other events. Return the world and its recorder.

    A client has subscribed to every key.
    """
    tape, world = recorded_world(config, wanted=EVERY_KEY)
    world.bus.publish("tf_static", world.loop.publication.report.tf_static())
    drive_through_faults(world, 4.0)
    happenings(world, random.Random(1))
    world.call("set", b'{"settings": {"limits.max_linear_velocity": 0.4}}')
    world.drive(0.9, 0.2, 1.0)
    world.send_together([0.1, 0.2, 0.3])
    world.run(0.3)
    return world, tape


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(PLAIN, id="plain"),
        pytest.param(CHECKED, id="checked", marks=pytest.mark.slow),
    ],
)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A drive, its recorder in memory, and the recording of it."""
    world, tape = driven(request.param)
    path = tmp_path_factory.mktemp("export") / "drive.rec.zst"
    return world, tape, Recording([tape.save(path, request.param)])


@pytest.fixture(scope="module")
def file(recorded: Any) -> Path:
    """The exported file."""
    _, _, recording = recorded
    new: Path = recording.paths[0].with_name("new.mcap")
    assert export(recording, new, "mcap") > 1000
    return new


COUNTED = {"lines_rejected", "missed_periods", "command_refused", "new_sender"}
"""Events that repeat. `events` has them in one row with a total, and the log has a line each time.
"""


def happened(world: World) -> list[Any]:
    """Return all published events, each one once.

    Consecutive `events` messages contain the same events again.
    """
    log_events: list[Any] = []
    for events in world.bus.published["events"]:
        assert isinstance(events, Events)
        log_events += events.events[len(events.events) - (events.total - len(log_events)) :]
    return log_events


def commanded(source: str) -> str:
    """Return the topic of a source's commands."""
    return CMD_VEL_IN.topic("", source)


def replay_file(world: World, tape: Tape) -> Said:
    """Return the messages that a client received or sent, by ROS topic, except those of the log."""
    messages: Said = defaultdict(list)
    for key in BY_KEY:
        messages[BY_KEY[key].topic("")] = [_exportable(item) for item in world.bus.published[key]]
    for entry in tape.taken:
        for item in entry.heard.commands:
            arrived = item.arrived_ns + entry.now.wall_ns - entry.now.mono_ns
            asked = Twist(Vector3(x=item.twist.linear), Vector3(z=item.twist.angular))
            stamped = TwistStamped(Header(Time.from_ns(arrived), "base_link"), asked)
            messages[commanded(item.source)].append(stamped)
    return messages


def _exportable(message: Message) -> Any:
    """Return the message without those values that an export cannot contain.

    These are the daemon's measurements of its own process, for example its latencies.
    """
    if isinstance(message, DiagnosticArray):
        left_out = MEASURED_ROWS | {"acsard: recording"}
        rows = [row for row in message.status if row.name not in left_out]
        return DiagnosticArray(message.header, rows)
    if isinstance(message, Battery):
        return replace(message, **{name: _float32(getattr(message, name)) for name in MEASURES})
    return state(message) if isinstance(message, RobotState) else message


MEASURES = ("voltage", "current", "percentage")
"""The fields of the battery with a value."""


def _float32(value: float) -> float:
    return float(np.float32(value))


def name_of(data: bytes) -> str:
    """Return the event name in a CDR-encoded message of the topic `log`."""
    # CDR: four bytes of encapsulation, eight of the stamp, the level padded to four, the name.
    return data[20 : 19 + int.from_bytes(data[16:20], "little")].decode()


@pytest.mark.slow
def test_the_file_has_each_message_that_was_published_to_the_byte(
    recorded: Any, file: Path
) -> None:
    world, tape, _ = recorded
    written: dict[str, list[bytes]] = defaultdict(list)
    with file.open("rb") as stream:
        for _, channel, message in SeekingReader(stream).iter_messages():
            if channel.topic != "/log" or name_of(message.data) not in ADDED:
                written[channel.topic].append(message.data)
    rows = {row.topic("", "app"): row for row in CHANNELS}
    published = replay_file(world, tape)
    # The samples of the gyro were received, not published.
    assert written.keys() - {"/imu/data"} == {*published, "/log"} >= set(rows)
    for name, messages in published.items():
        data = [rows.get(name, CMD_VEL_IN).encode(item) for item in messages]
        assert written[name] == data, f"{name}: {len(written[name])} of {len(data)}"
    events = happened(world)
    assert len(written["/log"]) == len(events)
    others = {
        item.name
        for item, data in zip(events, written["/log"], strict=True)
        if LOG_CHANNEL.encode(log(item, item.stamp)) != data
    }
    assert others <= COUNTED
