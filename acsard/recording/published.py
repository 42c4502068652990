"""Rebuilds the messages that a robot published, while its recording is replayed.

The daemon's `Report` builds the messages, as if a client had subscribed to every topic all the
time. A recording does not hold the daemon's measurements of itself, so the rows of `diagnostics`
that contain them are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from msgspec.structs import replace

from acsard.core.messages.report import Look, Report
from acsard.core.messages.schema import DiagnosticArray, RobotState, TFMessage, Time
from acsard.core.robot import Robot
from acsard.core.ros.channels import BY_KEY, CMD_VEL_IN, LOG, Channel, published_channels
from acsard.core.ros.shapes import asked, log
from acsard.core.ros.transports import left_out
from acsard.core.values import Command, Instant, Outputs
from acsard.recording.recorded_steps import Step

MEASURED = frozenset({"acsard: control loop", "acsard: certificate"})
"""Rows of `diagnostics` that need more than the inputs of the steps."""


class Published(NamedTuple):
    """Message with the time at which it was published.

    `source` names the commander of a command channel.
    """

    channel: Channel
    source: str
    wall_ns: int
    message: Any


class Publisher:
    """Source of the messages of a replayed robot.

    It takes the steps in order; some may be omitted.
    """

    def __init__(self, robot: Robot, started_ns: int) -> None:
        """Start.

        `started_ns`, the wall-clock time of the daemon's start, stamps the static messages.
        """
        self._robot, self._config = robot, robot.config
        self._report = Report(robot.config, Instant(0, started_ns))
        self._wanted = self._listened()
        self._static: TFMessage | None = None
        self._latches = True

    def _listened(self) -> frozenset[str]:
        names = {channel.native for channel in published_channels(left_out(self._config))}
        return frozenset(names & BY_KEY.keys())

    def step(self, step: Step, outputs: Outputs) -> Iterator[Published]:
        """Yield the messages of a step after its replay: commands first, log lines last."""
        # A setting was changed.
        if self._robot.config is not self._config:
            self._config = self._robot.config
            self._report.use(self._config)
            self._wanted = self._listened()
            self._latches = True
        now = step.inputs.now
        for command in step.inputs.commands:
            yield self._heard(command, now)
        yield from self._latched(now)
        for key, message in self._report.due(outputs, self._wanted, self._look(now)):
            yield Published(BY_KEY[key], "", now.wall_ns, _recorded(message))
        for event in step.said.events:
            line = log(event, Time.from_ns(now.wall_ns))
            yield Published(LOG, "", now.wall_ns, line)

    def _look(self, now: Instant) -> Look:
        return lambda: self._robot.snapshot(now.mono_ns)

    def _latched(self, now: Instant) -> Iterator[Published]:
        """Yield `tf_static` once, and again when a setting has changed it."""
        if self._latches and "tf_static" in self._wanted:
            self._latches = False
            static = self._report.tf_static()
            if static != self._static:
                self._static = static
                yield Published(BY_KEY["tf_static"], "", now.wall_ns, static)

    def _heard(self, command: Command, now: Instant) -> Published:
        arrived_ns = command.arrived_ns + now.wall_ns - now.mono_ns
        frame = self._config.odometry.base_frame
        message = asked(command.twist, Time.from_ns(arrived_ns), frame)
        return Published(CMD_VEL_IN, command.source, arrived_ns, message)


def _recorded(message: Any) -> Any:
    """Return the message without the fields that a recording does not hold."""
    match message:
        case RobotState():
            return replace(message, certificate_expiry="", latencies={})
        case DiagnosticArray():
            rows = [row for row in message.status if row.name not in MEASURED]
            return DiagnosticArray(message.header, rows)
    return message
