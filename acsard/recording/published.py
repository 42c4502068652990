"""Rebuilds the messages that a robot published, while its recording is replayed.

The daemon's class `Report` builds the messages as if a client had subscribed to every topic for the
whole time. A recording does not contain the daemon's measurements of itself, so these values are
omitted from `state` and `diagnostics`. The messages on `log` are the entries of `timeline.py`. The
robot did not publish some of these entries, such as `drive` and `reason`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from msgspec.structs import replace

from acsard.core.messages.report import Report
from acsard.core.messages.schema import DiagnosticArray, RobotState, TFMessage, Time
from acsard.core.robot import Robot
from acsard.core.ros.channels import BY_KEY, CMD_VEL_IN, LOG_CHANNEL, Channel, published_channels
from acsard.core.ros.shapes import LEVELS, Log, command_message
from acsard.core.ros.transports import left_out
from acsard.core.values import NS_PER_S, Command, Instant, Outputs
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.timeline import TimelineEntry, TimelineWriter

MEASURED_ROWS = frozenset({"acsard: control loop", "acsard: certificate"})
"""Names of the rows that are omitted from `diagnostics`, because a recording does not contain their
values."""


MAX_ROUNDING_NS = 1000
"""Upper bound of the rounding error of `TimelineEntry.seconds`, ns. The time between two steps is
always longer."""


class Published(NamedTuple):
    """A message that a robot published, or a command that it received, with the time."""

    channel: Channel
    source: str
    """Command source of a received command; "" for a published message."""
    wall_ns: int
    """Wall-clock time at which the message was published or the command arrived, ns since 1970."""
    message: Any


class Publisher:
    """Rebuilds the messages of a replayed robot, step by step."""

    def __init__(self, robot: Robot, started_ns: int) -> None:
        """Prepare for the first step.

        Args:
            robot: the robot that replays the steps, before its first step.
            started_ns: wall-clock time of the daemon's start, ns since 1970. This time becomes the
                stamp of the messages that never change.
        """
        self.robot = robot
        """The robot that replays the steps. If the replay goes on with another robot, the caller
        must assign the new robot to this attribute."""
        self._config = robot.config
        self._report = Report(robot.config, Instant(0, started_ns))
        self._wanted = self._wanted_keys()
        self._timeline = TimelineWriter(robot.config)
        self._now = Instant(0, started_ns)
        self._static: TFMessage | None = None
        self._static_due = True
        """True if the message `tf_static` must be built: at the first step, and after a change of a
        setting."""

    def _wanted_keys(self) -> frozenset[str]:
        names = {channel.native for channel in published_channels(left_out(self._config))}
        return frozenset(names & BY_KEY.keys())

    def step(self, step: RecordedStep, outputs: Outputs) -> Iterator[Published]:
        """Yield the messages of a step that was just replayed.

        The received commands come first, and the log lines come last. `outputs` are the replayed
        outputs. Call this method or `skip` for each step, in order.
        """
        # A step that changes a setting gives the robot a new configuration.
        if self.robot.config is not self._config:
            self._config = self.robot.config
            self._report.use(self._config)
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
        messages = self._report.due(outputs, self._wanted, lambda: self.robot.snapshot(now.mono_ns))
        for key, message in messages:
            yield Published(BY_KEY[key], "", now.wall_ns, _without_measurements(message))
        yield from self.skip(step)

    def skip(self, step: RecordedStep) -> Iterator[Published]:
        """Yield only the log lines of a step. The step need not have been replayed."""
        self._now = step.inputs.now
        yield from map(self._line, self._timeline.step(step))

    def end(self, ending: str = "") -> Iterator[Published]:
        """Yield the log lines after the last step.

        `ending` says how the recording was cut off, or is "" if the daemon ended normally.
        """
        yield from map(self._line, self._timeline.end(ending))

    def _line(self, entry: TimelineEntry) -> Published:
        wall_ns = round(entry.seconds * NS_PER_S)
        # The time of an entry is rounded to a fraction of a us. Use the exact time of the step
        # instead, so that the log agrees with the stamps of the other messages.
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
            return replace(message, certificate_expiry="", certificate_days=None, latencies={})
        case DiagnosticArray():
            rows = [row for row in message.status if row.name not in MEASURED_ROWS]
            return DiagnosticArray(message.header, rows)
    return message
