"""Exports a recording for other programs: as ROS messages in MCAP or a ROS bag, or as CSV.

In the CSV, each feedback line and each gyro sample has a row, which begins with the columns that
`acsard calibrate` reads. It must not use `odom_...` as measured positions: odometry is computed
with the dimensions that the calibration has to find.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec
from mcap.writer import Writer
from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.ros.channels import ENCODING, SCHEMA_ENCODING, Channel
from acsard.core.ros.names import TYPE_HASHES, Qos
from acsard.core.values import NS_PER_S, Estimate, GyroSample, Instant, Ns, Outputs, WallNs
from acsard.host.errors import RecordingError
from acsard.host.version import version
from acsard.recording.atomic_output import METADATA, replacing, synced
from acsard.recording.file_replay import (
    PROGRESS_STEPS,
    Gap,
    Progress,
    RecordedRun,
    no_progress,
)
from acsard.recording.mcap_file import About, Recording
from acsard.recording.published import Published, Publisher
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.time_span import WHOLE_SPAN, Span

_RELIABLE, _BEST_EFFORT = 1, 2
_TRANSIENT_LOCAL, _VOLATILE = 1, 2

_ENDLESS = "{sec: 9223372036, nsec: 854775807}"


class BagTopic(Struct, frozen=True):
    name: str
    type: str
    qos: Qos
    count: int


def offered_qos(qos: Qos) -> str:
    """Return a QoS profile as rosbag2 expects it: a YAML list with one entry."""
    return "\n".join(
        [
            "- history: 1",
            f"  depth: {qos.depth}",
            f"  reliability: {_BEST_EFFORT if qos.best_effort else _RELIABLE}",
            f"  durability: {_TRANSIENT_LOCAL if qos.transient else _VOLATILE}",
            f"  deadline: {_ENDLESS}",
            f"  lifespan: {_ENDLESS}",
            "  liveliness: 1",
            f"  liveliness_lease_duration: {_ENDLESS}",
            "  avoid_ros_namespace_conventions: false",
            "",
        ]
    )


def bag_metadata(file: str, topics: Sequence[BagTopic], first_ns: Ns, last_ns: Ns) -> str:
    """Return the `metadata.yaml` of a ROS bag with one MCAP file.

    Format version 5 with numeric QoS policies is read by every ROS 2 release since Humble.
    """
    count = sum(topic.count for topic in topics)
    begins = f"nanoseconds_since_epoch: {first_ns}"
    lasts = f"nanoseconds: {last_ns - first_ns}"
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: mcap",
        f"  duration: {{{lasts}}}",
        f"  starting_time: {{{begins}}}",
        f"  message_count: {count}",
        "  topics_with_message_count:",
    ]
    for topic in topics:
        lines += [
            "    - topic_metadata:",
            f"        name: {_quoted(topic.name)}",
            f"        type: {_quoted(topic.type)}",
            "        serialization_format: cdr",
            f"        offered_qos_profiles: {_quoted(offered_qos(topic.qos))}",
            f"      message_count: {topic.count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        f"  relative_file_paths: [{_quoted(file)}]",
        "  files:",
        f"    - path: {_quoted(file)}",
        f"      starting_time: {{{begins}}}",
        f"      duration: {{{lasts}}}",
        f"      message_count: {count}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    # A name or a path may contain YAML syntax. A JSON string is also a YAML string.
    return msgspec.json.encode(text).decode()


# For a calibration: s since 1970, rad/s of the wheels, and rad/s of the gyro.
MEASURED_COLUMNS = (
    "t",
    "fr",
    "fl",
    "rl",
    "rr",
    "yaw_rate",
)

# SI units; empty for a gyro sample.
OUTPUT_COLUMNS = (
    "odom_x", "odom_y", "odom_yaw", "linear", "angular",
    "applied_linear", "applied_angular", "mode", "link", "source",
)  # fmt: skip

CSV_HEADER = ",".join([*MEASURED_COLUMNS, *OUTPUT_COLUMNS])
MEASURED_CSV_HEADER = ",".join([*MEASURED_COLUMNS, "applied_linear", "applied_angular"])

_NO_WHEELS = "," * 4
_NO_OUTPUTS = "," * len(OUTPUT_COLUMNS)


def csv_rows(step: RecordedStep, outputs: Outputs) -> Iterator[str]:
    """Yield the rows of a step for the CSV of an export, by its replayed outputs."""
    now = step.inputs.now
    for sample in step.inputs.gyro:
        yield gyro_columns(sample, now) + _NO_OUTPUTS
    if outputs.estimates:
        applied = f"{outputs.applied.linear:.6g},{outputs.applied.angular:.6g}"
        status = f"{outputs.mode},{outputs.link},{outputs.source}"
        for estimate in outputs.estimates:
            pose = f"{estimate.pose.x:.6f},{estimate.pose.y:.6f},{estimate.pose.yaw:.6f}"
            twist = f"{estimate.twist.linear:.6g},{estimate.twist.angular:.6g}"
            yield f"{wheel_columns(estimate)},{pose},{twist},{applied},{status}"


def measured_csv_rows(step: RecordedStep, outputs: Outputs) -> Iterator[str]:
    """Yield the rows of a step for `acsard calibrate` (`MEASURED_CSV_HEADER`)."""
    for sample in step.inputs.gyro:
        yield gyro_columns(sample, step.inputs.now) + ",,"
    for estimate in outputs.estimates:
        applied = f"{outputs.applied.linear:.6g},{outputs.applied.angular:.6g}"
        yield f"{wheel_columns(estimate)},{applied}"


def wheel_columns(estimate: Estimate) -> str:
    """Return the `MEASURED_COLUMNS` of a feedback line."""
    wheels = ",".join(f"{speed:.6g}" for speed in estimate.speeds.as_tuple())
    return f"{_csv_seconds(estimate.at.wall_ns)},{wheels},"


def gyro_columns(sample: GyroSample, now: Instant) -> str:
    """Return the `MEASURED_COLUMNS` of a gyro sample, at its stamp or else its arrival."""
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return f"{_csv_seconds(at_ns)},{_NO_WHEELS}{sample.rate:.6g}"


def _csv_seconds(wall_ns: WallNs) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"


Kind = Literal["mcap", "csv", "rosbag2"]

# End of the default name.
SUFFIX: dict[Kind, str] = {"mcap": ".ros2.mcap", "csv": ".csv", "rosbag2": ".rosbag2"}


class ExportResult(Struct, frozen=True):
    count: int  # messages, or rows of a CSV
    gaps: list[Gap]  # exported parts that cannot be replayed, whose outputs are missing


class _Writer:
    count = 0

    def step(self, step: RecordedStep, outputs: Outputs) -> None:
        raise NotImplementedError

    def skip(self, step: RecordedStep, inside: bool) -> None:
        """Process a step without outputs: one that cannot be replayed, or is not inside."""

    def end(self, ending: str = "") -> None:
        """Write the log after the last step; `ending` says how the recording was cut off there."""

    def finish(self) -> None:
        pass


class _MessageWriter(_Writer):
    def __init__(self, stream: BinaryIO, run: RecordedRun, about: About, name: str) -> None:
        self._run = run
        self._publisher = Publisher(run.robot, about.started_ns or about.wall_ns)
        self._namespace = run.robot.config.ros.namespace
        self._writer = Writer(stream)
        self._writer.start("ros2", f"acsard {version()}")
        origin = {"robot": about.robot, "recording": name, "recorded_by": f"acsard {about.version}"}
        self._writer.add_metadata("acsard export", origin)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._topics: dict[int, tuple[str, Channel]] = {}
        self._counts: dict[int, int] = {}
        self.times: tuple[int, int] = (0, 0)  # earliest and latest message

    def step(self, step: RecordedStep, outputs: Outputs) -> None:
        self._publisher.robot = self._run.robot
        with self._run.state_errors():
            messages = list(self._publisher.step(step, outputs))
        self._add(messages)

    def skip(self, step: RecordedStep, inside: bool) -> None:
        with self._run.state_errors():
            messages = list(self._publisher.skip(step))
        if inside:
            self._add(messages)

    def end(self, ending: str = "") -> None:
        with self._run.state_errors():
            messages = list(self._publisher.end(ending))
        self._add(messages)

    def _add(self, messages: list[Published]) -> None:
        for message in messages:
            number = self._channels.get((message.channel.name, message.source))
            if number is None:
                number = self._open(message.channel, message.source)
            # MCAP cannot store times before 1970.
            wall_ns = max(0, message.wall_ns)
            self._counts[number] += 1
            with self._run.state_errors():
                data = message.channel.encode(message.message)
            self._writer.add_message(number, wall_ns, data, wall_ns, self._counts[number])
            first, last = self.times if self.count else (wall_ns, wall_ns)
            self.times = (min(first, wall_ns), max(last, wall_ns))
            self.count += 1

    def _open(self, channel: Channel, source: str) -> int:
        kind = channel.schema_name
        if kind not in self._schemas:
            text = channel.schema.encode()
            self._schemas[kind] = self._writer.register_schema(kind, SCHEMA_ENCODING, text)
        topic = channel.topic(self._namespace, source)
        # `ros2 bag play FILE` reads the QoS profile from the channel of the MCAP file.
        about = {"offered_qos_profiles": offered_qos(channel.qos)}
        if kind in TYPE_HASHES:
            about["topic_type_hash"] = TYPE_HASHES[kind]
        number: int = self._writer.register_channel(topic, ENCODING, self._schemas[kind], about)
        self._channels[channel.name, source] = number
        self._topics[number], self._counts[number] = (topic, channel), 0
        return number

    def finish(self) -> None:
        self._writer.finish()

    @property
    def topics(self) -> list[BagTopic]:
        return [
            BagTopic(name, channel.schema_name, channel.qos, self._counts[number])
            for number, (name, channel) in self._topics.items()
        ]


class _TableWriter(_Writer):
    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._stream.write(f"{CSV_HEADER}\n".encode())

    def step(self, step: RecordedStep, outputs: Outputs) -> None:
        for row in csv_rows(step, outputs):
            self._stream.write(f"{row}\n".encode())
            self.count += 1


def export(
    recording: Recording,
    new: Path,
    kind: Kind,
    other: Config | None = None,
    span: Span = WHOLE_SPAN,
    progress: Progress = no_progress,
    force: bool = False,
) -> ExportResult:
    """Replay a recording, and write its messages or its CSV table to `new`.

    `other` replaces the recorded configuration. `force` never replaces a recording. An error leaves
    nothing at `new`: `RecordingError` (nothing in `span`, or no replay), `FileExistsError`,
    `OSError`.
    """
    run = RecordedRun(recording, other)
    with replacing(new, force) as part:
        file = part
        if kind == "rosbag2":
            part.mkdir()
            file = part / f"{new.name}_0.mcap"
        writer: _TableWriter | _MessageWriter
        with file.open("wb") as stream:
            if kind == "csv":
                writer = _TableWriter(stream)
            else:
                with run.state_errors():
                    writer = _MessageWriter(stream, run, recording.about, recording.path.name)
            _write_steps(run, writer, recording, span, progress)
            if not writer.count:
                raise RecordingError(
                    f"{recording.path} has nothing in that span of time; correct --from and --to"
                )
            writer.finish()
            synced(stream)
        if kind == "rosbag2" and isinstance(writer, _MessageWriter):
            with (part / METADATA).open("wb") as stream:
                stream.write(bag_metadata(file.name, writer.topics, *writer.times).encode())
                synced(stream)
        return ExportResult(writer.count, _gaps(run, span, recording.about))


def _write_steps(
    run: RecordedRun, writer: _Writer, recording: Recording, span: Span, progress: Progress
) -> None:
    # The steps before `span` are replayed too, because each step changes the robot.
    began_ns, over = recording.about.mono_ns, False

    def is_inside(step: RecordedStep) -> bool:
        # Ends the output at the first step after `span`.
        nonlocal over
        seconds = (step.inputs.now.mono_ns - began_ns) / NS_PER_S
        if seconds > span.end and not over:
            over = True
            if writer.count:
                writer.end()
        return span.begin <= seconds <= span.end

    def skip(step: RecordedStep) -> None:
        inside = is_inside(step)
        if not over:
            writer.skip(step, inside)

    run.on_skipped = skip
    for number, step in enumerate(run.steps()):
        if number % PROGRESS_STEPS == 0:
            progress(step.inputs.now.wall_ns)
        with run.state_errors():
            outputs = run.stepped.step(step.inputs)
        if is_inside(step):
            writer.step(step, outputs)
        elif not over:
            writer.skip(step, inside=False)
    if writer.count and not over:
        writer.end(recording.ending)


def _gaps(run: RecordedRun, span: Span, about: About) -> list[Gap]:
    begin_ns, end_ns = [about.mono_ns + seconds * NS_PER_S for seconds in span]
    return [gap for gap in run.gaps if gap.begin_ns < end_ns and gap.end_ns > begin_ns]


def calibration_csv(recording: Recording) -> bytes:
    """Return a recording as the CSV that `acsard calibrate` reads.

    It has the steps from the first that can be replayed to the next that cannot. Raises
    `RecordingError`, also without gyro samples.
    """
    run = RecordedRun(recording)
    lines, has_gyro = [MEASURED_CSV_HEADER], False
    last: int | None = None
    with run.state_errors():
        for step in run.steps():
            if last is not None and step.number != last + 1:
                # A calibration compares whole drives, and part of this drive is missing.
                break
            last = step.number
            lines += measured_csv_rows(step, run.stepped.step(step.inputs))
            has_gyro = has_gyro or bool(step.inputs.gyro)
    if not has_gyro:
        raise RecordingError(
            f"{recording.path} has no gyro samples to compare the wheels with: either record a "
            "drive with [odometry] gyro = true, or export this recording with --csv and add the "
            "columns x and y of a sensor that measures positions"
        )
    return ("\n".join(lines) + "\n").encode()
