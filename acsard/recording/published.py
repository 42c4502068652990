"""Rebuilds the messages that a robot published, while its recording is replayed.

`Report` builds them as if a client had subscribed to everything. `state` and `diagnostics` lack the
daemon's measurements of itself, which are not recorded. Messages on `log` are the entries of
`timeline.py`, some of which the robot did not publish.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.messages.report import Report
from acsard.core.messages.schema import (
    DiagnosticArray,
    Header,
    Imu,
    RobotState,
    Time,
    Vector3,
)
from acsard.core.robot import Robot
from acsard.core.ros.channels import BY_KEY, CMD_VEL_IN, IMU_CHANNEL, LOG_CHANNEL, Channel
from acsard.core.ros.shapes import LEVELS, Log, command_message
from acsard.core.ros.transports import unused_keys
from acsard.core.summary import summary
from acsard.core.values import Command, GyroSample, Instant, News, WallNs
from acsard.recording.file import Recording
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.replay import Playback
from acsard.recording.timeline import Timeline, TimelineEntry

EXPORTED = (*BY_KEY, IMU_CHANNEL.native)

UNMEASURED = [-1.0] + [0.0] * 8  # covariance of a quantity that is not measured

# Rows of `diagnostics` that are not recorded.
MEASURED_ROWS = frozenset({"acsard: control loop", "acsard: certificate"})


class Published(NamedTuple):
    """A message that a robot published, or a command that it received."""

    channel: Channel
    source: str  # of a received command
    wall_ns: WallNs
    message: Any


def published(
    recording: Recording, other: Config | None = None, keys: Collection[str] = EXPORTED
) -> Iterator[Published]:
    """Replay a recording, and yield its commands, its log, and the messages on these keys.

    `other` replaces the recorded configuration. Raises `RecordingError`.
    """
    playback, timeline = Playback(recording, other), Timeline()
    publisher: Publisher | None = None
    for record in recording.records():
        replayed = playback.take(record)
        if replayed is not None:
            if publisher is None or publisher.robot is not playback.robot:
                started_ns = playback.head.started_ns if playback.head else 0
                publisher = Publisher(playback.robot, started_ns, keys)
            with playback.errors():
                yield from publisher.messages(*replayed, recording)
        if recording.includes(record):
            yield from map(_line, timeline.take(record))


class Publisher:
    """Builds the messages of one robot."""

    def __init__(self, robot: Robot, started_ns: WallNs, keys: Collection[str]) -> None:
        # `started_ns`, the daemon's start, is the stamp of messages that never change.
        self.robot, self._keys = robot, keys
        self._report = Report(robot.config, Instant(0, started_ns))
        self._static: Config | None = None  # of the last `tf_static`

    @property
    def _config(self) -> Config:
        return self.robot.config

    def messages(self, step: RecordedStep, news: News, recording: Recording) -> Iterator[Published]:
        """Yield the messages of a step that was just replayed, if it is in the recording's time."""
        # The steps before that time determine when messages are due.
        messages = list(self._messages(step, news))
        if recording.contains(step.now):
            yield from self._transforms(step)
            yield from messages

    def _transforms(self, step: RecordedStep) -> Iterator[Published]:
        # At the first step, and after a change of a setting.
        if self._config is not self._static and "tf_static" in self._keys:
            self._static = self._report.config = self._config
            if "tf_static" not in unused_keys(self._config):
                message = self._report.tf_static()
                yield Published(BY_KEY["tf_static"], "", step.now.wall_ns, message)

    def _messages(self, step: RecordedStep, news: News) -> Iterator[Published]:
        robot, now = self.robot, step.now
        self._report.config = robot.config
        for command in step.heard.commands:
            yield self._received(command, now)
        for sample in step.heard.gyro if IMU_CHANNEL.native in self._keys else ():
            yield self._gyro(sample, now)
        applied = robot.applied if step.driven else None
        for key, message in self._report.due(
            now, news, applied, self._keys, lambda: summary(robot, now.mono_ns)
        ):
            yield Published(BY_KEY[key], "", now.wall_ns, _without_measurements(message))

    def _gyro(self, sample: GyroSample, now: Instant) -> Published:
        arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
        stamp_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
        header = Header(Time.from_ns(stamp_ns), self._config.odometry.base_frame)
        variances = [*[0.0] * 8, sample.variance]
        message = Imu(
            header=header,
            orientation_covariance=UNMEASURED,
            angular_velocity=Vector3(z=sample.rate),
            angular_velocity_covariance=variances,
            linear_acceleration_covariance=UNMEASURED,
        )
        return Published(IMU_CHANNEL, "", arrived_ns, message)

    def _received(self, command: Command, now: Instant) -> Published:
        arrived_ns = command.arrived_ns + now.wall_ns - now.mono_ns
        frame = self._config.odometry.base_frame
        message = command_message(command.twist, Time.from_ns(arrived_ns), frame)
        return Published(CMD_VEL_IN, command.source, arrived_ns, message)


def _line(entry: TimelineEntry) -> Published:
    stamp, level = Time.from_ns(entry.wall_ns), LEVELS[entry.level]
    line = Log(stamp, level, entry.name, entry.sentence)
    return Published(LOG_CHANNEL, "", entry.wall_ns, line)


def _without_measurements(message: Any) -> Any:
    match message:
        case RobotState():
            return replace(
                message, certificate="", certificate_expiry="", certificate_days=None, latencies={}
            )
        case DiagnosticArray():
            rows = [row for row in message.status if row.name not in MEASURED_ROWS]
            return DiagnosticArray(message.header, rows)
    return message
