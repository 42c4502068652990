"""Lives a recording again: `Robot.step` over the same inputs, compared with what was said then.

Nothing but the inputs and the configuration decides what a robot does, so by the same code and
configuration every line, mode and pose comes out the same. By others, the differences are the
answer to "what would it have done".
"""

from __future__ import annotations

import math
from functools import lru_cache

from msgspec import Struct

from acsard.config.settings import Config
from acsard.guard import Guard, Memory
from acsard.record.steps import (
    MICRO,
    Micropose,
    Status,
    Step,
    checksum,
    microposes,
    status_of,
)
from acsard.robot import Robot
from acsard.values import Instant, Outputs

FAULT = "fault"


class Seen(Struct, frozen=True):
    """What one side knew of a step."""

    line: bytes | None
    status: Status
    poses: tuple[Micropose, ...]
    trip: str = ""
    """Why the guard replaced the line."""


class Difference(Struct, frozen=True):
    """A step that did not come out as it did then."""

    number: int
    at: Instant
    what: tuple[str, ...]
    """Of `line`, `left`, `mode`, `pose`."""
    then: Seen
    now: Seen


class Tally(Struct):
    """What a replay found so far."""

    steps: int = 0
    lines: int = 0
    """Lines then, and those of now that were none then."""
    lines_same: int = 0
    poses: int = 0
    poses_same: int = 0
    modes_same: int = 0
    exact: bool = True
    """Every pose is the same to the last bit."""
    first: Difference | None = None
    fault: Difference | None = None
    """Where a fault began that was none then."""
    apart: float = 0.0
    """m between the two poses, at most."""
    fastest: tuple[int, int] = (0, 0)
    """The fastest wheel of a line, then and now, hundredths of rad/s."""
    end: tuple[Micropose, Micropose] | None = None
    """The last poses, then and now."""

    @property
    def same(self) -> bool:
        """Every line, mode and pose."""
        return self.first is None


def lived(robot: Robot, step: Step) -> Outputs:
    """What the robot says of it now; what the loop counts beside the robot is counted as then."""
    outputs = robot.step(step.inputs)
    said, inputs = step.said, step.inputs
    if said.left is not None:
        robot.counters["lines_sent"] += 1
    elif said.line is not None and inputs.tick and inputs.port_open:
        robot.counters["lines_superseded"] += 1
    return outputs


class Replay:
    """One robot that lives again, step by step."""

    def __init__(
        self, config: Config, robot: Robot | None = None, memory: Memory | None = None
    ) -> None:
        """Start from `robot` and the guard's `memory` before the first step, or from nothing."""
        self.robot = robot or Robot(config)
        self.outputs: Outputs | None = None
        """What the last step decided now."""
        self._config = self.robot.config
        self._guard = Guard(self.robot.session.codec.stop, self._config, memory)
        self._checksum = 0
        self._here: Micropose = (0, 0, 0)
        self.tally = Tally()

    def step(self, step: Step) -> Difference | None:
        """Live it; what came out otherwise than then, None when nothing did."""
        if step.begins:
            self._checksum = 0
        outputs = self.outputs = lived(self.robot, step)
        if self.robot.config is not self._config:  # a setting was changed
            self._config = self.robot.config
            self._guard.use(self._config)
        line, trip = self._guard.check(outputs)
        self._checksum = checksum(outputs.estimates, self._checksum)
        if step.said.left is not None:
            # What the board got then is what it obeys, whatever would go now.
            self._guard.left(step.said.left)
        now = Seen(outputs.line, status_of(outputs), microposes(outputs.estimates), trip)
        difference = self._compare(step, now, line)
        self._count(step, outputs, now)
        if difference is not None:
            self._keep(difference)
        return difference

    def _keep(self, difference: Difference) -> None:
        """What is told of them all."""
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
    """The fastest wheel of a line, hundredths of rad/s; 0 where there is none to read."""
    if line is None:
        return 0
    tokens = [line[start + 2 : start + 7].replace(b".", b"") for start in (0, 8, 16, 24)]
    return max([int(token) for token in tokens if token.isdigit()], default=0)
