"""Exports a recording for other programs: as ROS messages in MCAP or a ROS bag, or as CSV."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, Literal, Protocol

from mcap.writer import Writer
from msgspec import Struct

from acsard import __version__
from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.core.ros.channels import ENCODING, SCHEMA_ENCODING, Channel
from acsard.core.ros.names import TYPE_HASHES
from acsard.core.values import NS_PER_S, Outputs
from acsard.host.errors import RecordingError
from acsard.recording import csv_table, ros_bag
from acsard.recording.atomic_output import beside, synced
from acsard.recording.file import About, Recording
from acsard.recording.published import Published, Publisher
from acsard.recording.recorded_steps import Step
from acsard.recording.replay import lived
from acsard.recording.replayed import EVERY, Course, Progress, quietly
from acsard.recording.time_span import WHOLE, Span

Kind = Literal["mcap", "csv", "rosbag2"]

SUFFIX: dict[Kind, str] = {"mcap": ".ros2.mcap", "csv": ".csv", "rosbag2": ".rosbag2"}
"""Suffix of the exported file if the user gives no name."""


class Done(Struct, frozen=True):
    """Result of an export."""

    count: int
    """Number of messages, or of lines of a table."""
    trouble: str
    """Why the export ends before the recording does; "" if it is complete."""


class _Sink(Protocol):
    count: int

    def step(self, step: Step, outputs: Outputs) -> None:
        """Write the output of a replayed step."""

    def finish(self) -> None:
        """Write the end of the file."""


class _Messages:
    """Writer of ROS messages to an MCAP file."""

    def __init__(self, stream: BinaryIO, robot: Robot, about: About, name: str) -> None:
        self._publisher = Publisher(robot, about.started_ns or about.wall_ns)
        self._namespace = robot.config.ros.namespace
        self._writer = Writer(stream)
        self._writer.start("ros2", f"acsard {__version__}")
        made = {"robot": about.robot, "recording": name, "recorded_by": f"acsard {about.version}"}
        self._writer.add_metadata("acsard export", made)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._topics: dict[int, tuple[str, Channel]] = {}
        self._counts: dict[int, int] = {}
        self.count = 0
        self.times: tuple[int, int] = (0, 0)
        """Wall-clock times of the first and the last message, ns."""

    def step(self, step: Step, outputs: Outputs) -> None:
        for one in self._publisher.step(step, outputs):
            self._add(one)

    def _add(self, one: Published) -> None:
        number = self._channels.get((one.channel.name, one.source))
        if number is None:
            number = self._open(one.channel, one.source)
        wall_ns = max(0, one.wall_ns)
        self._counts[number] += 1
        data = one.channel.encode(one.message)
        self._writer.add_message(number, wall_ns, data, wall_ns, self._counts[number])
        first, last = self.times if self.count else (wall_ns, wall_ns)
        self.times = (min(first, wall_ns), max(last, wall_ns))
        self.count += 1

    def _open(self, channel: Channel, source: str) -> int:
        """Register a new channel, and return its number in the file."""
        kind = channel.schema_name
        if kind not in self._schemas:
            text = channel.schema.encode()
            self._schemas[kind] = self._writer.register_schema(kind, SCHEMA_ENCODING, text)
        topic = channel.topic(self._namespace, source)
        about = {"offered_qos_profiles": ros_bag.offered(channel.qos)}
        if kind in TYPE_HASHES:
            about["topic_type_hash"] = TYPE_HASHES[kind]
        number: int = self._writer.register_channel(topic, ENCODING, self._schemas[kind], about)
        self._channels[channel.name, source] = number
        self._topics[number], self._counts[number] = (topic, channel), 0
        return number

    def finish(self) -> None:
        self._writer.finish()

    @property
    def topics(self) -> list[ros_bag.Topic]:
        return [
            ros_bag.Topic(name, channel.schema_name, channel.qos, self._counts[number])
            for number, (name, channel) in self._topics.items()
        ]


class _Table:
    """Writer of the table as CSV."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._stream.write(f"{csv_table.HEADER}\n".encode())
        self.count = 0

    def step(self, step: Step, outputs: Outputs) -> None:
        for row in csv_table.rows(step, outputs):
            self._stream.write(f"{row}\n".encode())
            self.count += 1

    def finish(self) -> None: ...


def export(
    recording: Recording,
    new: Path,
    kind: Kind,
    other: Config | None = None,
    span: Span = WHOLE,
    progress: Progress = quietly,
    force: bool = False,
) -> Done:
    """Export a recording to `new`: a file, or a directory for `rosbag2`.

    `other` replaces the recording's own configuration. Raises `RecordingError` if there is nothing
    to write, `FileExistsError` if `new` must not be replaced (with `force` it may, see `beside`),
    and any other `OSError`. After an error no partial file is left.
    """
    course = Course(recording, other)

    def written(sink: _Sink, stream: BinaryIO) -> None:
        with course.living():
            _all(course, sink, span, progress)
        if not sink.count:
            raise RecordingError(f"{recording.path} has nothing in that span of time")
        sink.finish()
        synced(stream)

    def messages(stream: BinaryIO) -> _Messages:
        with course.living():
            return _Messages(stream, course.robot, recording.about, recording.path.name)

    with beside(new, force) as part:
        if kind == "rosbag2":
            part.mkdir()
            file = part / f"{new.name}_0.mcap"
            with file.open("wb") as stream:
                written(sink := messages(stream), stream)
            with (part / "metadata.yaml").open("wb") as stream:
                stream.write(ros_bag.metadata(file.name, sink.topics, *sink.times).encode())
                synced(stream)
            return Done(sink.count, course.trouble)
        with part.open("wb") as stream:
            one: _Sink = _Table(stream) if kind == "csv" else messages(stream)
            written(one, stream)
        return Done(one.count, course.trouble)


def _all(course: Course, sink: _Sink, span: Span, progress: Progress) -> None:
    began_ns = None
    for number, step in enumerate(course.steps()):
        now = step.inputs.now
        began_ns = now.mono_ns if began_ns is None else began_ns
        if number % EVERY == 0:
            progress(now.wall_ns)
        outputs = lived(course.robot, step)
        if span.begin <= (now.mono_ns - began_ns) / NS_PER_S <= span.end:
            sink.step(step, outputs)


def measured(recording: Recording) -> bytes:
    """Return the CSV table that `acsard calibrate` reads.

    Raises `RecordingError` if the recording has no gyro samples, because calibration cannot use it.
    """
    course = Course(recording)
    lines, turned = [csv_table.MEASURED_HEADER], False
    with course.living():
        for step in course.steps():
            lines += csv_table.measured(step, lived(course.robot, step))
            turned = turned or bool(step.inputs.gyro)
    if not turned:
        raise RecordingError(
            f"{recording.path} has no gyro samples with which to compare the wheels: record a "
            "drive with [odometry] gyro = true, or export it with --csv and add the columns x "
            "and y of a sensor that measures positions"
        )
    return ("\n".join(lines) + "\n").encode()
