"""Rebuilds the messages that a robot published, while its recording is replayed.

`Report` builds them as if a client had subscribed to everything. `state` and `diagnostics` lack the
daemon's measurements of itself, which are not recorded. Messages on `log` are the entries of
`timeline.py`, some of which the robot did not publish.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from msgspec.structs import replace

from acsard.core.messages.report import Report
from acsard.core.messages.schema import DiagnosticArray, RobotState, TFMessage, Time
from acsard.core.robot import Robot
from acsard.core.ros.channels import BY_KEY, CMD_VEL_IN, LOG_CHANNEL, Channel, published_channels
from acsard.core.ros.shapes import LEVELS, Log, command_message
from acsard.core.ros.transports import left_out
from acsard.core.values import NS_PER_S, Command, Instant, Outputs, WallNs
from acsard.recording.file_replay import PROGRESS_STEPS, Progress, RecordedRun, no_progress
from acsard.recording.mcap_file import Recording
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.stepped_robot import news_of
from acsard.recording.time_span import Span
from acsard.recording.timeline import TimelineEntry, TimelineWriter

# Rows of `diagnostics` that are not recorded.
MEASURED_ROWS = frozenset({"acsard: control loop", "acsard: certificate"})


MAX_ROUNDING_NS = 1000  # of `TimelineEntry.seconds`; two steps are always further apart


class Published(NamedTuple):
    """A message that a robot published, or a command that it received."""

    channel: Channel
    source: str  # of a received command
    wall_ns: WallNs
    message: Any


def published(
    recording: Recording, span: Span, progress: Progress = no_progress
) -> Iterator[Published]:
    """Replay a recording, and yield the messages in a part of it. Raises `RecordingError`."""
    run, about = RecordedRun(recording), recording.about
    skipped: list[RecordedStep] = []
    run.on_skipped = skipped.append
    with run.state_errors():
        publisher = Publisher(run.robot, about.started_ns or about.wall_ns)
        for number, step in enumerate(run.steps()):
            if number % PROGRESS_STEPS == 0:
                progress(step.inputs.now.wall_ns)
            messages = [message for late in skipped for message in publisher.skip(late)]
            skipped.clear()
            outputs = run.stepped.step(step.inputs)
            publisher.robot = run.robot
            messages += publisher.step(step, outputs)
            if span.begin <= (step.inputs.now.mono_ns - about.mono_ns) / NS_PER_S <= span.end:
                yield from messages
        if span.end == math.inf:
            yield from publisher.end(recording.ending)


class Publisher:
    def __init__(self, robot: Robot, started_ns: WallNs) -> None:
        # `started_ns`, the daemon's start, is the stamp of messages that never change.
        self.robot = robot  # replays the steps; assign another one if the replay goes on with it
        self._config = robot.config
        self._report = Report(robot.config, Instant(0, started_ns))
        self._wanted = self._wanted_keys()
        self._timeline = TimelineWriter(robot.config)
        self._now = Instant(0, started_ns)
        self._static: TFMessage | None = None
        self._static_due = True  # at the first step, and after a change of a setting

    def _wanted_keys(self) -> frozenset[str]:
        names = {channel.native for channel in published_channels(left_out(self._config))}
        return frozenset(names & BY_KEY.keys())

    def step(self, step: RecordedStep, outputs: Outputs) -> Iterator[Published]:
        """Yield the messages of a step that was just replayed: commands first, the log last.

        Call this method or `skip` for each step, in order.
        """
        # A step that changes a setting gives the robot a new configuration.
        if self.robot.config is not self._config:
            self._config = self.robot.config
            self._report.config = self._config
            self._wanted = self._wanted_keys()
            self._static_due = True
        now = step.inputs.now
        for command in step.inputs.commands:
            yield self._received(command, now)
        if self._static_due and "tf_static" in self._wanted:
            self._static_due = False
            static = self._report.tf_static()
            if static != self._static:
                self._static = static
                yield Published(BY_KEY["tf_static"], "", now.wall_ns, static)
        messages = self._report.due(
            now,
            news_of(outputs),
            outputs.applied if outputs.due else None,
            self._wanted,
            lambda: self.robot.snapshot(now.mono_ns),
        )
        for key, message in messages:
            yield Published(BY_KEY[key], "", now.wall_ns, _without_measurements(message))
        yield from self.skip(step)

    def skip(self, step: RecordedStep) -> Iterator[Published]:
        """Yield only the log of a step, which need not have been replayed."""
        self._now = step.inputs.now
        yield from map(self._line, self._timeline.step(step))

    def end(self, ending: str = "") -> Iterator[Published]:
        """Yield the log after the last step; `ending` says how the recording was cut off."""
        yield from map(self._line, self._timeline.end(ending))

    def _line(self, entry: TimelineEntry) -> Published:
        wall_ns = round(entry.seconds * NS_PER_S)
        # The time of an entry is rounded. That of the step agrees with the other messages.
        if abs(wall_ns - self._now.wall_ns) < MAX_ROUNDING_NS:
            wall_ns = self._now.wall_ns
        line = Log(Time.from_ns(wall_ns), LEVELS[entry.level], entry.name, entry.sentence)
        return Published(LOG_CHANNEL, "", wall_ns, line)

    def _received(self, command: Command, now: Instant) -> Published:
        arrived_ns = command.arrived_ns + now.wall_ns - now.mono_ns
        frame = self._config.odometry.base_frame
        message = command_message(command.twist, Time.from_ns(arrived_ns), frame)
        return Published(CMD_VEL_IN, command.source, arrived_ns, message)


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
