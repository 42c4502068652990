"""Writes a recording for other programs: ROS messages in MCAP, or a CSV table.

In the table, each feedback line and each gyro sample has a row, which begins with the columns that
`acsard calibrate` reads. It must not use `odom_...` as measured positions: odometry is computed
with the dimensions that the calibration has to find.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO, Literal

from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.core.ros.channels import ENCODING, SCHEMA_ENCODING, Channel
from acsard.core.ros.names import TYPE_HASHES, Qos
from acsard.core.values import (
    NS_PER_S,
    TWO_WHEELS,
    WHEELS,
    Estimate,
    GyroSample,
    Instant,
    News,
    Twist,
    WallNs,
)
from acsard.host.errors import RecordingError
from acsard.host.version import version
from acsard.recording.file import SUFFIX, Recording
from acsard.recording.published import Published, published
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.replay import Playback, config_of

Kind = Literal["mcap", "csv"]

# End of the default name.
ENDINGS: dict[Kind, str] = {"mcap": ".mcap", "csv": ".csv"}

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
        count = (_write_mcap if kind == "mcap" else _write_csv)(recording, part, other)
        if not count:
            raise recording.nothing()
        return count


def _write_csv(recording: Recording, file: Path, other: Config | None) -> int:
    rows = table(recording, other)
    with file.open("w", encoding="ascii", newline="\n") as stream:
        return sum(1 for row in rows if stream.write(",".join(row) + "\n")) - 1


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
        part.unlink(missing_ok=True)


# ROS messages


def _write_mcap(recording: Recording, file: Path, other: Config | None) -> int:
    head = recording.head()
    if head is None:
        return 0
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
        self._channels: dict[tuple[str, str], int] = {}  # by name and source
        self._counts: Counter[int] = Counter()  # messages of each channel
        self._writer.start("ros2", f"acsard {version()}")
        self._writer.add_metadata("acsard export", origin)

    def add(self, message: Published) -> None:
        which = message.channel.name, message.source
        if which not in self._channels:
            self._channels[which] = self._open(message.channel, message.source)
        number = self._channels[which]
        self._counts[number] += 1
        at_ns = max(0, message.wall_ns)  # MCAP cannot store times before 1970
        data = message.channel.encode(message.message)
        self._writer.add_message(number, at_ns, data, at_ns, self._counts[number])

    def _open(self, channel: Channel, source: str) -> int:
        kind = channel.schema_name
        if kind not in self._schemas:
            text = channel.schema.encode()
            self._schemas[kind] = self._writer.register_schema(kind, SCHEMA_ENCODING, text)
        # `ros2 bag play FILE` reads the QoS profile from the channel of the MCAP file.
        about = {"offered_qos_profiles": offered_qos(channel.qos)}
        if kind in TYPE_HASHES:
            about["topic_type_hash"] = TYPE_HASHES[kind]
        name = channel.topic(self._namespace, source)
        return self._writer.register_channel(name, ENCODING, self._schemas[kind], about)

    def finish(self) -> int:
        self._writer.finish()
        return self._counts.total()


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


# The table

# By the driven wheels, whose order is that of the values.
WHEEL_COLUMNS = {WHEELS: ("fr", "fl", "rl", "rr"), TWO_WHEELS: TWO_WHEELS}

# SI units; empty for a gyro sample.
OUTPUT_COLUMNS = ("odom_x", "odom_y", "odom_yaw", "linear", "angular", "mode", "link", "source")

Cells = tuple[str, ...]


def table(recording: Recording, other: Config | None = None) -> Iterator[Cells]:
    """Yield the header and the rows of the table of a recording. Raises `RecordingError`."""
    playback = Playback(recording, other)
    wheels = _wheel_columns(playback, recording, other)
    yield measured_columns(wheels) + OUTPUT_COLUMNS
    for step, news in playback.steps():
        if recording.contains(step.now):
            yield from _rows(step, news, playback.robot, len(wheels))


def _wheel_columns(playback: Playback, recording: Recording, other: Config | None) -> Cells:
    with playback.errors():
        head = recording.head()
        config = other or (Config() if head is None else config_of(head))
        return WHEEL_COLUMNS[config.mcu.wheels.names]


def _rows(step: RecordedStep, news: News, robot: Robot, wheels: int) -> Iterator[Cells]:
    for sample in step.heard.gyro:
        yield gyro_cells(sample, step.now, wheels) + ("",) * len(OUTPUT_COLUMNS)
    status = robot.status
    for estimate in news.estimates:
        pose, twist = estimate.pose, estimate.twist
        yield (
            *feedback_cells(estimate, robot.applied, wheels),
            *[f"{value:.6f}" for value in (pose.x, pose.y, pose.yaw)],
            *[f"{value:.6g}" for value in (twist.linear, twist.angular)],
            status.mode, status.link, status.source,
        )  # fmt: skip


def measured_columns(wheels: Cells) -> Cells:
    """Return those for a calibration: s since 1970, rad/s of the wheels, and rad/s of the gyro."""
    return ("t", *wheels, "yaw_rate", "applied_linear", "applied_angular")


def feedback_cells(estimate: Estimate, applied: Twist, wheels: int) -> Cells:
    """Return the `measured_columns` of a feedback line."""
    measured = [f"{speed:.6g}" for speed in estimate.speeds.as_tuple()[:wheels]]
    speeds = f"{applied.linear:.6g}", f"{applied.angular:.6g}"
    return (_seconds(estimate.at.wall_ns), *measured, "", *speeds)


def gyro_cells(sample: GyroSample, now: Instant, wheels: int) -> Cells:
    """Return the `measured_columns` of a gyro sample, at its stamp or else its arrival."""
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return (_seconds(at_ns), *[""] * wheels, f"{sample.rate:.6g}", "", "")


def _seconds(wall_ns: WallNs) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"


def calibration_csv(recording: Recording) -> bytes:
    """Return a recording as the CSV that `acsard calibrate` reads, up to the first gap.

    Raises `RecordingError`, also without gyro samples.
    """
    playback, has_gyro = Playback(recording), False
    columns = _wheel_columns(playback, recording, None)
    rows, wheels = [measured_columns(columns)], len(columns)
    for step, news in playback.steps():
        if playback.gaps:
            # A calibration compares whole drives, and part of this drive is missing.
            break
        rows += [gyro_cells(sample, step.now, wheels) for sample in step.heard.gyro]
        applied = playback.robot.applied
        rows += [feedback_cells(estimate, applied, wheels) for estimate in news.estimates]
        has_gyro = has_gyro or bool(step.heard.gyro)
    if not has_gyro:
        names = ", ".join([path.name for path in recording.paths])
        raise RecordingError(
            f"{names} has no gyro samples to compare the wheels with: either record a "
            "drive with [odometry] gyro = true, or export this recording with --csv and add the "
            "columns x and y of a sensor that measures positions"
        )
    return ("\n".join(map(",".join, rows)) + "\n").encode()
