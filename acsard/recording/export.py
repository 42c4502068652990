"""Writes a recording for other programs: ROS messages in MCAP or a ROS 2 bag, or a CSV table.

In the table, each feedback line and each gyro sample has a row, which begins with the columns that
`acsard calibrate` reads. It must not use `odom_...` as measured positions: odometry is computed
with the dimensions that the calibration has to find.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec
from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.core.ros.channels import ENCODING, SCHEMA_ENCODING, Channel
from acsard.core.ros.names import TYPE_HASHES, Qos
from acsard.core.values import NS_PER_S, Estimate, GyroSample, Instant, News, Twist, WallNs
from acsard.host.errors import RecordingError
from acsard.host.version import version
from acsard.recording.file import SUFFIX, Recording
from acsard.recording.published import Published, published
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.replay import Playback, config_of

Kind = Literal["mcap", "csv", "rosbag2"]

# End of the default name.
ENDINGS: dict[Kind, str] = {"mcap": ".mcap", "csv": ".csv", "rosbag2": ".rosbag2"}

_RELIABLE, _BEST_EFFORT = 1, 2
_TRANSIENT_LOCAL, _VOLATILE = 1, 2

_ENDLESS = "{sec: 9223372036, nsec: 854775807}"


def export(
    recording: Recording, new: Path, kind: Kind, other: Config | None = None, force: bool = False
) -> int:
    """Replay a recording, and write its messages or its table to `new`; return their number.

    `other` replaces the recorded configuration. An error leaves nothing at `new`: `RecordingError`
    (nothing to write, or no replay), `FileExistsError`, `OSError`.
    """
    with replacing(new, force) as part:
        count = _write(recording, part, new.name, kind, other)
        if not count:
            raise RecordingError("there is nothing to export; correct --from and --to")
        return count


def _write(recording: Recording, part: Path, name: str, kind: Kind, other: Config | None) -> int:
    match kind:
        case "csv":
            rows = table(recording, other)
            with part.open("w", encoding="ascii", newline="\n") as stream:
                return sum(1 for row in rows if stream.write(",".join(row) + "\n")) - 1
        case "mcap":
            return _write_mcap(recording, part, other).count
        case "rosbag2":
            part.mkdir()
            file = f"{name}_0.mcap"
            written = _write_mcap(recording, part / file, other)
            (part / "metadata.yaml").write_text(bag_metadata(file, written), encoding="utf-8")
            return written.count


@contextmanager
def replacing(new: Path, force: bool) -> Iterator[Path]:
    """Yield a temporary path, and rename it to `new` after the block, unless the block fails.

    Raises `FileExistsError` if `new` must not be replaced.
    """
    if new.name.endswith(SUFFIX):
        raise FileExistsError(EEXIST, f"{SUFFIX} is the end of a recording's name; choose another")
    if new.is_symlink() or new.exists():
        if new.is_dir():
            raise FileExistsError(EEXIST, "this path is a directory; name another path")
        if not new.is_file():
            raise FileExistsError(EEXIST, "this path is a device or a pipe; name a file")
        if not force:
            raise FileExistsError(EEXIST, "this path exists already; --force overwrites it")
    part = new.with_name(f".{new.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, new)
    finally:
        if part.is_dir():
            shutil.rmtree(part)
        else:
            part.unlink(missing_ok=True)


# ROS messages


class BagTopic(Struct):
    name: str
    channel: Channel
    number: int  # of the channel in the MCAP file
    count: int = 0


class Written(Struct):
    """What is in an MCAP file."""

    topics: dict[tuple[str, str], BagTopic] = {}  # by name of the channel, and source
    count: int = 0  # messages
    first_ns: WallNs = 0
    last_ns: WallNs = 0


def _write_mcap(recording: Recording, file: Path, other: Config | None) -> Written:
    head = recording.head()
    if head is None:
        return Written()
    names = ", ".join([path.name for path in recording.paths])
    origin = {"robot": head.robot, "recording": names, "recorded_by": f"acsard {head.version}"}
    with file.open("wb") as stream:
        mcap = _McapFile(stream, origin, (other or config_of(head)).ros.namespace)
        for message in published(recording, other):
            mcap.add(message)
        return mcap.finish()


class _McapFile:
    def __init__(self, stream: BinaryIO, origin: dict[str, str], namespace: str) -> None:
        from mcap.writer import Writer  # nothing else needs it

        self._writer, self._namespace = Writer(stream), namespace
        self._schemas: dict[str, int] = {}
        self._written = Written()
        self._writer.start("ros2", f"acsard {version()}")
        self._writer.add_metadata("acsard export", origin)

    def add(self, message: Published) -> None:
        channel, written = message.channel, self._written
        topic = written.topics.get((channel.name, message.source))
        if topic is None:
            topic = self._open(channel, message.source)
        at_ns = max(0, message.wall_ns)  # MCAP cannot store times before 1970
        topic.count += 1
        data = channel.encode(message.message)
        self._writer.add_message(topic.number, at_ns, data, at_ns, topic.count)
        written.first_ns = min(written.first_ns, at_ns) if written.count else at_ns
        written.last_ns = max(written.last_ns, at_ns)
        written.count += 1

    def _open(self, channel: Channel, source: str) -> BagTopic:
        kind = channel.schema_name
        if kind not in self._schemas:
            text = channel.schema.encode()
            self._schemas[kind] = self._writer.register_schema(kind, SCHEMA_ENCODING, text)
        # `ros2 bag play FILE` reads the QoS profile from the channel of the MCAP file.
        about = {"offered_qos_profiles": offered_qos(channel.qos)}
        if kind in TYPE_HASHES:
            about["topic_type_hash"] = TYPE_HASHES[kind]
        name = channel.topic(self._namespace, source)
        number = self._writer.register_channel(name, ENCODING, self._schemas[kind], about)
        topic = self._written.topics[channel.name, source] = BagTopic(name, channel, number)
        return topic

    def finish(self) -> Written:
        self._writer.finish()
        return self._written


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


def bag_metadata(file: str, written: Written) -> str:
    """Return the `metadata.yaml` of a ROS bag with one MCAP file.

    Format version 5 with numeric QoS policies is read by every ROS 2 release since Humble.
    """
    begins = f"nanoseconds_since_epoch: {written.first_ns}"
    lasts = f"nanoseconds: {written.last_ns - written.first_ns}"
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: mcap",
        f"  duration: {{{lasts}}}",
        f"  starting_time: {{{begins}}}",
        f"  message_count: {written.count}",
        "  topics_with_message_count:",
    ]
    for topic in written.topics.values():
        lines += [
            "    - topic_metadata:",
            f"        name: {_quoted(topic.name)}",
            f"        type: {_quoted(topic.channel.schema_name)}",
            "        serialization_format: cdr",
            f"        offered_qos_profiles: {_quoted(offered_qos(topic.channel.qos))}",
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
        f"      message_count: {written.count}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    # A name or a path may contain YAML syntax. A JSON string is also a YAML string.
    return msgspec.json.encode(text).decode()


# The table

# For a calibration: s since 1970, rad/s of the wheels, and rad/s of the gyro.
MEASURED_COLUMNS = ("t", "fr", "fl", "rl", "rr", "yaw_rate", "applied_linear", "applied_angular")

# SI units; empty for a gyro sample.
OUTPUT_COLUMNS = ("odom_x", "odom_y", "odom_yaw", "linear", "angular", "mode", "link", "source")

Cells = tuple[str, ...]


def table(recording: Recording, other: Config | None = None) -> Iterator[Cells]:
    """Yield the header and the rows of the table of a recording. Raises `RecordingError`."""
    yield MEASURED_COLUMNS + OUTPUT_COLUMNS
    playback = Playback(recording, other)
    for step, news in playback.steps():
        if recording.contains(step.now):
            yield from _rows(step, news, playback.robot)


def _rows(step: RecordedStep, news: News, robot: Robot) -> Iterator[Cells]:
    for sample in step.heard.gyro:
        yield gyro_cells(sample, step.now) + ("",) * len(OUTPUT_COLUMNS)
    status = robot.status
    for estimate in news.estimates:
        pose, twist = estimate.pose, estimate.twist
        yield (
            *feedback_cells(estimate, robot.applied),
            *[f"{value:.6f}" for value in (pose.x, pose.y, pose.yaw)],
            *[f"{value:.6g}" for value in (twist.linear, twist.angular)],
            status.mode, status.link, status.source,
        )  # fmt: skip


def feedback_cells(estimate: Estimate, applied: Twist) -> Cells:
    """Return the `MEASURED_COLUMNS` of a feedback line."""
    wheels = [f"{speed:.6g}" for speed in estimate.speeds.as_tuple()]
    speeds = f"{applied.linear:.6g}", f"{applied.angular:.6g}"
    return (_seconds(estimate.at.wall_ns), *wheels, "", *speeds)


def gyro_cells(sample: GyroSample, now: Instant) -> Cells:
    """Return the `MEASURED_COLUMNS` of a gyro sample, at its stamp or else its arrival."""
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return (_seconds(at_ns), "", "", "", "", f"{sample.rate:.6g}", "", "")


def _seconds(wall_ns: WallNs) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"


def calibration_csv(recording: Recording) -> bytes:
    """Return a recording as the CSV that `acsard calibrate` reads, up to the first gap.

    Raises `RecordingError`, also without gyro samples.
    """
    rows: list[Cells] = [MEASURED_COLUMNS]
    playback, has_gyro = Playback(recording), False
    for step, news in playback.steps():
        if playback.gaps:
            # A calibration compares whole drives, and part of this drive is missing.
            break
        rows += [gyro_cells(sample, step.now) for sample in step.heard.gyro]
        rows += [feedback_cells(estimate, playback.robot.applied) for estimate in news.estimates]
        has_gyro = has_gyro or bool(step.heard.gyro)
    if not has_gyro:
        names = ", ".join([path.name for path in recording.paths])
        raise RecordingError(
            f"{names} has no gyro samples to compare the wheels with: either record a "
            "drive with [odometry] gyro = true, or export this recording with --csv and add the "
            "columns x and y of a sensor that measures positions"
        )
    return ("\n".join(map(",".join, rows)) + "\n").encode()
