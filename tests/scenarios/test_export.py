"""An export contains exactly the messages that the bus had during the recording.

The tests compare the messages that the export creates. They also compare the exported file, byte by
byte and through independent readers.
"""

from __future__ import annotations

import math
import random
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from mcap_ros2.decoder import DecoderFactory
from msgspec.structs import replace
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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
from acsard.core.ros.channels import BY_KEY, CHANNELS, CMD_VEL_IN, LOG_CHANNEL
from acsard.core.ros.shapes import log, state
from acsard.recording.export import export
from acsard.recording.file import Recording
from acsard.recording.published import MEASURED_ROWS, published
from tests.each import each
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


def exported(recording: Recording) -> Said:
    messages: Said = defaultdict(list)
    for item in published(recording):
        messages[item.channel.native.replace("<source>", item.source)].append(item.message)
    assert recording.damage == []
    return messages


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
def both(recorded: Any) -> Any:
    """The world with the published messages, its recorder, and the exported messages."""
    world, tape, recording = recorded
    return world, tape, exported(recording)


@pytest.fixture(scope="module")
def file(recorded: Any) -> Path:
    """The exported file."""
    _, _, recording = recorded
    new: Path = recording.paths[0].with_name("new.mcap")
    assert export(recording, new, "mcap") > 1000
    return new


def assert_same(then: Sequence[Message], now: Sequence[Message]) -> None:
    """Compare two lists of messages. The failure shows the first difference."""
    for number, (item, other) in enumerate(zip(then, now, strict=False)):
        assert item == other, f"message {number}"
    assert len(then) == len(now) > 0


@pytest.mark.slow
@each("key", ["odom", "tf", "tf_static", "wheel_states", "cmd_vel_out", "battery"])
def test_every_exported_message_equals_the_published_one(key: str, both: Any) -> None:
    world, _, exports = both
    assert_same(world.bus.published[key], exports[key])


def without_lines(counters: dict[str, int]) -> dict[str, int]:
    """Return counters without those of lines: a replay learns a step later that a line left."""
    return {name: count for name, count in counters.items() if not name.startswith("lines_")}


def test_every_exported_state_equals_the_published_one_without_latencies_and_version(
    both: Any,
) -> None:
    world, _, exports = both
    then = [
        replace(robot_state, latencies={}, version="", counters=without_lines(robot_state.counters))
        for robot_state in world.bus.published["state"]
    ]
    assert all(
        isinstance(robot_state, RobotState) and robot_state.counters["lines"]
        for robot_state in then[20:]
    )
    states = [
        replace(robot_state, counters=without_lines(robot_state.counters))
        for robot_state in exports["state"]
    ]
    assert_same(then, states)
    assert then[-1].counters["commands_superseded"] > 0


def without_counts(messages: Sequence[Any]) -> list[DiagnosticArray]:
    """Return diagnostics without the counts of lines (`without_lines`)."""
    return [
        replace(
            message,
            status=[
                replace(row, values=[v for v in row.values if not v.key.startswith("lines_")])
                for row in message.status
            ],
        )
        for message in messages
    ]


def test_every_exported_diagnostics_has_the_same_rows_except_measured_ones(both: Any) -> None:
    world, _, exports = both
    left_out = MEASURED_ROWS | {"acsard: recording"}
    then = [
        DiagnosticArray(message.header, [row for row in message.status if row.name not in left_out])
        for message in world.bus.published["diagnostics"]
    ]
    assert_same(without_counts(then), without_counts(exports["diagnostics"]))
    assert {row.name for row in then[-1].status} >= {"acsard: mode", "acsard: commands"}


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


def test_every_event_is_a_line_of_the_log(both: Any) -> None:
    world, _, exports = both
    events = happened(world)
    assert len(events) > 20
    lines = [line for line in exports[LOG_CHANNEL.native] if line.name not in ADDED]
    assert [(e.stamp, e.name) for e in events] == [(e.stamp, e.name) for e in lines]
    others = {
        event.name
        for event, line in zip(events, lines, strict=True)
        if log(event, line.stamp) != line
    }
    assert others <= COUNTED


def test_every_line_reason_of_the_log_is_a_reason_that_the_state_has(both: Any) -> None:
    _, tape, exports = both
    lines = [line for line in exports[LOG_CHANNEL.native] if line.name == "reason"]
    steps = {step.now.wall_ns: step.recorded.status for step in tape.steps()}
    assert lines
    for line in lines:
        status = steps[line.stamp.to_ns()]
        mode, reason = status.mode, status.reason
        assert line.msg.partition(" (by ")[0] == f"{mode}: {reason}"


def test_every_command_is_exported_under_its_source_with_its_arrival_time(both: Any) -> None:
    _, tape, exports = both
    offset_ns = {}
    arrivals: Said = defaultdict(list)
    for entry in tape.taken:
        offset_ns = entry.now.wall_ns - entry.now.mono_ns
        for command in entry.heard.commands:
            arrivals[f"cmd/{command.source}"].append(
                (command.arrived_ns + offset_ns, command.twist.linear, command.twist.angular)
            )
    assert set(arrivals) == {key for key in exports if key.startswith("cmd/")} >= {"cmd/app"}
    for key, commands in arrivals.items():
        values = [
            (m.header.stamp.to_ns(), m.twist.linear.x, m.twist.angular.z) for m in exports[key]
        ]
        assert values == commands


# the file


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


def by_mcap_ros2(path: Path, reader: Any) -> Iterator[tuple[str, Any]]:
    """Return the topics and messages of a file, as the library mcap_ros2 decodes them.

    It uses only the message definitions in the file.
    """
    with path.open("rb") as stream:
        for message in reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            yield message.channel.topic, message.decoded_message


def by_rosbags(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the topics and messages of a file, as the library rosbags decodes them.

    It knows no message type beforehand and uses only the definitions in the file.
    """
    store: Any = get_typestore(Stores.EMPTY)
    with path.open("rb") as stream:
        for schema, channel, message in NonSeekingReader(stream).iter_messages():
            assert schema is not None
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            yield channel.topic, store.deserialize_cdr(message.data, schema.name)


@cache
def fields(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    return kind.__struct_fields__


def same(message: Any, ours: Any) -> bool:
    """Return whether two messages are equal in every field. NaN equals None."""
    if isinstance(ours, msgspec.Struct):
        return all(same(getattr(message, name), getattr(ours, name)) for name in fields(type(ours)))
    if isinstance(ours, (list, tuple)):
        return len(message) == len(ours) and all(map(same, message, ours))
    if ours is None:
        return math.isnan(message)
    return bool(message == ours)


@pytest.mark.slow
@pytest.mark.parametrize("library", ["seeking", "not seeking", "rosbags"])
def test_two_libraries_decode_the_file_by_its_definitions_to_the_published_messages(
    library: str, recorded: Any, file: Path
) -> None:
    world, tape, _ = recorded
    readers = {"seeking": SeekingReader, "not seeking": NonSeekingReader}
    messages = by_mcap_ros2(file, readers[library]) if library in readers else by_rosbags(file)
    by_topic: Said = defaultdict(list)
    for name, message in messages:
        by_topic[name].append(message)
    for name, sent in replay_file(world, tape).items():
        assert len(by_topic[name]) == len(sent) > 0
        for number, (item, ours) in enumerate(zip(by_topic[name], sent, strict=True)):
            assert same(item, ours), f"{name}, message {number}: {item} for {ours}"
    lines = [
        (item.stamp.sec, item.stamp.nanosec, item.name)
        for item in by_topic["/log"]
        if item.name not in ADDED
    ]
    assert lines == [(item.stamp.sec, item.stamp.nanosec, item.name) for item in happened(world)]


def test_the_libraries_decode_by_the_definitions_in_the_file(file: Path, tmp_path: Path) -> None:
    # The definitions are in the compressed chunks and after them, where a seeking reader looks
    # first.
    whole = file.read_bytes()
    other = tmp_path / "other.mcap"
    other.write_bytes(whole.replace(b"string child_frame_id", b"string child_grame_id"))
    with other.open("rb") as stream:
        reader = SeekingReader(stream, decoder_factories=[DecoderFactory()])
        message = next(iter(reader.iter_decoded_messages("/odom")))
    assert message.decoded_message.child_grame_id == "base_link"
    assert not hasattr(message.decoded_message, "child_frame_id")
