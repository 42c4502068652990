"""Replays a recording: runs `Robot.step` over the recorded inputs and compares the outputs.

A robot's behaviour depends only on its inputs and its configuration. The same code and
configuration therefore reproduce every line, mode and pose. With other code or another
configuration, the differences show how the robot would have behaved.
"""

from __future__ import annotations

import math
from functools import lru_cache

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.guard import Guard, Memory
from acsard.core.robot import Robot
from acsard.core.values import Instant, Outputs
from acsard.recording.recorded_steps import (
    MICRO,
    Micropose,
    Status,
    Step,
    checksum,
    microposes,
    status_of,
)

FAULT = "fault"


class Seen(Struct, frozen=True):
    """Outputs of one side, recorded or replayed, for a step."""

    line: bytes | None
    status: Status
    poses: tuple[Micropose, ...]
    trip: str = ""
    """Why the guard replaced the line; "" if it did not."""


class Difference(Struct, frozen=True):
    """A step whose replay differs from the recording."""

    number: int
    at: Instant
    what: tuple[str, ...]
    """The outputs that differ, out of `line`, `left`, `mode` and `pose`."""
    then: Seen
    now: Seen


class Comparison(Struct):
    """Totals of a replay so far."""

    steps: int = 0
    lines: int = 0
    """Number of steps in which the recording, the replay or both have a line."""
    lines_same: int = 0
    poses: int = 0
    poses_same: int = 0
    modes_same: int = 0
    exact: bool = True
    """True while every recorded checksum matches: all poses are equal to the last bit."""
    first: Difference | None = None
    fault: Difference | None = None
    """First step in which the replay is in fault and the recording is not."""
    apart: float = 0.0
    """Largest distance between the recorded and the replayed pose, m."""
    fastest: tuple[int, int] = (0, 0)
    """Speed of the fastest wheel in any line, recorded and replayed, in hundredths of rad/s."""
    end: tuple[Micropose, Micropose] | None = None
    """The last poses, recorded and replayed."""

    @property
    def same(self) -> bool:
        """True if every line, mode and pose is equal."""
        return self.first is None


def lived(robot: Robot, step: Step) -> Outputs:
    """Run a step on the robot, and return its outputs.

    The robot's counters of sent and superseded lines, which the daemon's loop keeps, are counted as
    in the recording.
    """
    outputs = robot.step(step.inputs)
    said, inputs = step.said, step.inputs
    if said.left is not None:
        robot.counters["lines_sent"] += 1
    elif said.line is not None and inputs.tick and inputs.port_open:
        robot.counters["lines_superseded"] += 1
    return outputs


class Replay:
    """A robot that replays a recording step by step."""

    def __init__(
        self, config: Config, robot: Robot | None = None, memory: Memory | None = None
    ) -> None:
        """Start with `robot` and the guard's `memory`, or with a new robot."""
        self.robot = robot or Robot(config)
        self.outputs: Outputs | None = None
        """Outputs of the last replayed step."""
        self._config = self.robot.config
        self._guard = Guard(self.robot.session.codec.stop, self._config, memory)
        self._checksum = 0
        self._here: Micropose = (0, 0, 0)
        self.tally = Comparison()

    def step(self, step: Step) -> Difference | None:
        """Replay a step.

        Returns its difference from the recording, or None if all outputs are equal.
        """
        if step.begins:
            self._checksum = 0
        outputs = self.outputs = lived(self.robot, step)
        # A setting was changed.
        if self.robot.config is not self._config:
            self._config = self.robot.config
            self._guard.use(self._config)
        line, trip = self._guard.check(outputs)
        self._checksum = checksum(outputs.estimates, self._checksum)
        if step.said.left is not None:
            # The board obeyed the line that was sent then, even if the replay decides another.
            self._guard.left(step.said.left)
        now = Seen(outputs.line, status_of(outputs), microposes(outputs.estimates), trip)
        difference = self._compare(step, now, line)
        self._count(step, outputs, now)
        if difference is not None:
            self._keep(difference)
        return difference

    def _keep(self, difference: Difference) -> None:
        """Keep the first difference, and the first new fault."""
        tally = self.tally
        tally.first = tally.first or difference
        if difference.now.status[0] == FAULT != difference.then.status[0]:
            tally.fault = tally.fault or difference

    def _compare(self, step: Step, now: Seen, line: bytes | None) -> Difference | None:
        said = step.said
        then = Seen(said.line, said.status, said.poses)
        exact = said.checksum is None or said.checksum == self._checksum
        self.tally.exact = self.tally.exact and exact
        what = tuple(
            name
            for name, same in (
                ("line", now.line == said.line),
                ("left", said.left is None or line == said.left),
                ("mode", now.status[0] == said.status[0] and now.status[2:] == said.status[2:]),
                ("pose", now.poses == said.poses),
            )
            if not same
        )
        return Difference(step.number, step.inputs.now, what, then, now) if what else None

    def _count(self, step: Step, outputs: Outputs, now: Seen) -> None:
        tally, said = self.tally, step.said
        tally.steps += 1
        if said.line is not None or now.line is not None:
            tally.lines += 1
            tally.lines_same += said.line == now.line
        tally.modes_same += now.status[0] == said.status[0]
        tally.poses += len(said.poses)
        tally.poses_same += sum(a == b for a, b in zip(said.poses, now.poses, strict=False))
        then_most, now_most = tally.fastest
        tally.fastest = max(then_most, fastest(said.line)), max(now_most, fastest(now.line))
        if outputs.estimates:
            self._here = now.poses[-1]
        if said.poses:
            there = said.poses[-1]
            tally.end = there, self._here
            if there != self._here:
                away = math.hypot(there[0] - self._here[0], there[1] - self._here[1]) / MICRO
                tally.apart = max(tally.apart, away)


@lru_cache(64)
def fastest(line: bytes | None) -> int:
    """Return the highest wheel speed in a line, hundredths of rad/s; 0 if it cannot be read."""
    if line is None:
        return 0
    tokens = [line[start + 2 : start + 7].replace(b".", b"") for start in (0, 8, 16, 24)]
    return max([int(token) for token in tokens if token.isdigit()], default=0)
