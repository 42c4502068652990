"""Control steps as a recording stores them: with the outcome of a line in the step after it."""

from __future__ import annotations

from acsard.core.robot import Robot
from acsard.core.values import Heard, Inputs, Instant, News, Ns, Outputs, Trip


class LineOutcome:
    """What became of the line of a step, for the inputs of the next one."""

    def __init__(self, trip: Trip = "", superseded: bool = False, late_ns: Ns = 0) -> None:
        self.trip, self.superseded, self.late_ns = trip, superseded, late_ns


def inputs_of(
    now: Instant, heard: Heard, tick: bool, at_once: bool, outcome: LineOutcome
) -> Inputs:
    return Inputs(
        now,
        tick,
        heard.port_open,
        heard.opened,
        heard.port_trouble,
        heard.received,
        heard.commands,
        heard.requests,
        heard.gyro,
        heard.refusals,
        outcome.trip,
        outcome.superseded,
        heard.missed,
        heard.events,
        at_once,
        heard.shutting_down,
        outcome.late_ns,
        heard.speed_cap,
    )


def outputs_of(now: Instant, robot: Robot, news: News, due: bool, line: bytes | None) -> Outputs:
    status = robot.status
    return Outputs(
        now,
        due,
        line,
        robot.speeds,
        robot.applied,
        status.link == "up",
        news.estimates,
        status.mode,
        status.code,
        status.reason,
        status.link,
        status.source,
        robot.command_ns,
        news.status_changed,
        news.events,
        news.answers,
        news.urgent,
        robot.latches,
    )


def news_of(outputs: Outputs) -> News:
    return News(
        outputs.estimates, outputs.answers, outputs.events, outputs.news, outputs.status_changed
    )


class SteppedRobot:
    """A robot that gets recorded steps."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._made_ns: Ns = 0
        self._line: bytes | None = None  # of the last step

    def step(self, inputs: Inputs) -> Outputs:
        """Report the last line as sent or superseded, and return the outputs of the next step."""
        robot, now = self.robot, inputs.now
        self.tell(inputs)
        news = robot.hear(now, heard_of(inputs))
        due = inputs.tick or (inputs.at_once and news.urgent)
        self._line = robot.drive(now) if due else None
        self._made_ns = now.mono_ns
        return outputs_of(now, robot, news, due, self._line)

    def tell(self, inputs: Inputs) -> None:
        """Report the last line as sent or superseded, once, by the inputs of the next step."""
        if self._line is not None:
            line, self._line = None if inputs.superseded else self._line, None
            self.robot.sent(self._made_ns + inputs.late_ns, line, inputs.guard_trip)


def heard_of(inputs: Inputs) -> Heard:
    return Heard(
        inputs.port_open,
        inputs.opened,
        inputs.port_trouble,
        inputs.received,
        inputs.commands,
        inputs.refusals,
        inputs.requests,
        inputs.gyro,
        inputs.speed_cap,
        inputs.events,
        inputs.missed,
        inputs.shutting_down,
    )
