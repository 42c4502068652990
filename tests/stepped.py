"""A robot that makes one step at a time, from all inputs at once."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.codes import Code
from acsard.core.robot import Robot
from acsard.core.values import (
    Announcement,
    Answer,
    Command,
    Estimate,
    Event,
    GyroSample,
    Heard,
    Instant,
    Latches,
    News,
    Ns,
    Received,
    Refusal,
    Request,
    SpeedCap,
    Trip,
    Twist,
    WheelSpeeds,
)


class Inputs(Struct, frozen=True):
    """All inputs of one control step.

    - tick: compute the line of a control period.
    - at_once: maybe compute an extra line for a new command or mode.
    - opened: openings of the serial port; a new one is a new session with the board.
    """

    now: Instant
    tick: bool
    port_open: bool
    opened: int = 0
    port_trouble: str = ""  # why the port is closed
    received: tuple[Received, ...] = ()
    commands: tuple[Command, ...] = ()
    requests: tuple[Request, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    refusals: tuple[Refusal, ...] = ()  # messages that did not become a `Command`
    # Why the guard replaced the last line: the robot latches a fault.
    guard_trip: Trip = ""
    superseded: bool = False  # the previous line was not written
    missed: int = 0  # control periods without a step since the previous one
    events: tuple[Event, ...] = ()  # of other parts, to be logged with the robot's
    at_once: bool = False
    shutting_down: bool = False  # ramp to zero, and stay there
    # Time from the previous step to the write of its line, from 1 ms on: the process has stalled.
    late_ns: Ns = 0
    speed_cap: SpeedCap | None = None  # newest one since the previous step
    announced: tuple[Announcement, ...] = ()


class Outputs(Struct, frozen=True):
    """All results of one control step."""

    now: Instant
    due: bool  # this step had to compute a line
    line: bytes | None
    # Speeds of the last computed line; 0 if the speed was cut since, as by a lost link.
    speeds: WheelSpeeds
    applied: Twist  # after all limits, like `speeds`
    linked: bool  # otherwise the guard lets no wheel move
    estimates: tuple[Estimate, ...]
    mode: str
    code: Code  # why the robot moves or does not move
    reason: str  # in words
    link: str
    # Selected by the arbiter, which does not always drive: it may need a zero, or a latch holds.
    source: str
    command_ns: Ns | None  # arrival of the selected command
    status_changed: bool  # mode, reason, link, source or battery level
    events: tuple[Event, ...] = ()
    answers: tuple[Answer, ...] = ()
    # The board should get a new line at once: a new command or mode, or a pressed input. If this
    # step has computed it, `due` is true too.
    news: bool = False
    latches: Latches = Latches()  # another object if one has changed


def outputs_of(now: Instant, robot: Robot, news: News, due: bool, line: bytes | None) -> Outputs:
    status = robot.status
    return Outputs(
        now, due, line, robot.speeds, robot.applied, status.link == "up", news.estimates,
        status.mode, status.code, status.reason, status.link, status.source, robot.command_ns,
        news.status_changed, news.events, news.answers, news.urgent, robot.latches,
    )  # fmt: skip


def news_of(outputs: Outputs) -> News:
    return News(
        outputs.estimates, outputs.answers, outputs.events, outputs.news, outputs.status_changed
    )


class SteppedRobot:
    """A robot that makes a step at a time."""

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
        inputs.port_open, inputs.opened, inputs.port_trouble, inputs.received, inputs.commands,
        inputs.refusals, inputs.requests, inputs.gyro, inputs.speed_cap, inputs.events,
        inputs.missed, inputs.shutting_down, inputs.announced,
    )  # fmt: skip
