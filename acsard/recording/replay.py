"""Replays steps: runs `Robot.step` over the recorded inputs and compares the outputs.

A robot's behavior depends only on its inputs and its configuration. So the same code with the same
configuration reproduces every line, mode and pose. With other code or another configuration, the
differences show how the robot would have behaved.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import lru_cache
from itertools import zip_longest
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.guard import Guard, Memory
from acsard.core.robot import Robot
from acsard.core.values import Event, Instant, Outputs
from acsard.recording.recorded_steps import (
    MICRO,
    Micropose,
    RecordedOutputs,
    Step,
    checksum,
    count_superseded,
    input_names,
    micropose,
    status_of,
)

FAULT = "fault"

Output = Literal[
    "line",
    "sent line",
    "mode",
    "link",
    "source",
    "pose",
    "event",
    "client",
    "reason",
    "event text",
    "input names",
]
"""Name of an output whose recorded and replayed values are compared.

`line` is the line that the robot decided to send, and `sent line` is the line after the check by
the guard. `event` is any property of an event except its text and its client. `client` is the name
of the client in an event. `input names` are compared by a checksum of the whole batch, so a
difference is reported at the last step of the batch.
"""

WORDING: frozenset[Output] = frozenset({"reason", "event text"})
"""Outputs that are text for people. Another version may word them differently."""


class Difference(Struct, frozen=True):
    """A step whose replayed outputs differ from the recorded ones."""

    number: int
    at: Instant
    what: tuple[Output, ...]
    recorded: RecordedOutputs
    replayed: RecordedOutputs
    trip: str
    """Why the guard replaced the replayed line; "" if the guard did not replace it."""


class Comparison(Struct):
    """Result of a replay so far: how many outputs were compared, how many are equal, and the first
    differences."""

    steps: int = 0
    lines: int = 0
    """Number of steps with a recorded line, a replayed line or both."""
    lines_same: int = 0
    poses: int = 0
    poses_same: int = 0
    modes_same: int = 0
    reasons_same: int = 0
    links_same: int = 0
    sources_same: int = 0
    events: int = 0
    """Number of compared events. Each step adds its number of recorded or of replayed events,
    whichever is larger."""
    events_same: int = 0
    exact: bool = True
    """True if every checksum so far matches, so that all poses are equal to the last bit."""
    first: Difference | None = None
    first_by_output: dict[Output, Difference] = {}
    """Maps each output that differs to the first step in which it differs."""
    fault: Difference | None = None
    """First step in which the replayed robot, but not the recorded one, is in the mode `fault`."""
    apart: float = 0.0
    """Largest distance between the recorded and the replayed pose, m."""
    fastest: tuple[int, int] = (0, 0)
    """Pair: the highest wheel speed in the recorded lines and in the replayed lines, 0.01 rad/s."""
    end: tuple[Micropose, Micropose] | None = None
    """Pair: the last recorded pose, and the replayed pose at that step; None before any pose."""

    @property
    def same(self) -> bool:
        """True if every compared output is equal. Poses are compared to the um."""
        return self.first is None

    @property
    def only_words(self) -> bool:
        """True if outputs differ, but only in the wording of reasons and event texts."""
        return not self.same and self.first_by_output.keys() <= WORDING


def replay_step(robot: Robot, step: Step) -> Outputs:
    """Run `robot.step` with the inputs of a recorded step, and return the outputs.

    Also update the robot's counters of lines and commands, as the daemon's control loop did.
    """
    recorded, inputs = step.recorded, step.inputs
    if superseded := count_superseded(inputs.commands):
        robot.counters["commands_superseded"] += superseded
    outputs = robot.step(inputs)
    if recorded.sent is not None:
        robot.counters["lines_sent"] += 1
    elif recorded.line is not None and inputs.tick and inputs.port_open:
        robot.counters["lines_superseded"] += 1
    return outputs


class Replay:
    """A robot that replays a recording step by step."""

    def __init__(
        self, config: Config, robot: Robot | None = None, memory: Memory | None = None
    ) -> None:
        """Start with `robot` and the `memory` of its guard.

        If `robot` is None, start with a new robot that has the configuration `config`.
        """
        self.outputs: Outputs | None = None
        """Outputs of the last replayed step; None before the first step."""
        self.comparison = Comparison()
        self.resume(robot or Robot(config), memory)
        self._checksum = self._names = 0
        self._pose: Micropose = (0, 0, 0)

    def resume(self, robot: Robot, memory: Memory | None) -> None:
        """Continue with another robot and the memory of its guard, for example after a gap."""
        self.robot = robot
        self._config = robot.config
        self._guard = Guard(robot.session.codec.stop, robot.config, memory)

    def step(self, step: Step) -> Difference | None:
        """Replay a step, and return how its outputs differ from the recorded outputs.

        Returns None if they are equal.
        """
        if step.begins:
            self._checksum = self._names = 0
        outputs = self.outputs = replay_step(self.robot, step)
        # A step that changes a setting gives the robot a new configuration.
        if self.robot.config is not self._config:
            self._config = self.robot.config
            self._guard.use(self._config)
        line, trip = self._guard.check(outputs)
        self._checksum = checksum(outputs.estimates, self._checksum)
        self._names = input_names(step.inputs, self._names)
        if step.recorded.sent is not None:
            # The board obeyed the recorded line, even if the replay decides another one.
            self._guard.left(step.recorded.sent)
        poses = tuple([micropose(estimate) for estimate in outputs.estimates])
        sent = line if step.recorded.sent is not None else None
        replayed = RecordedOutputs(outputs.line, sent, status_of(outputs), poses, outputs.events)
        difference = self._compare(step, replayed, trip)
        self._count(step, outputs, replayed)
        if difference is not None:
            self._keep(difference)
        return difference

    def _keep(self, difference: Difference) -> None:
        comparison = self.comparison
        comparison.first = comparison.first or difference
        for output in difference.what:
            comparison.first_by_output.setdefault(output, difference)
        if difference.replayed.status[0] == FAULT != difference.recorded.status[0]:
            comparison.fault = comparison.fault or difference

    def _compare(self, step: Step, replayed: RecordedOutputs, trip: str) -> Difference | None:
        recorded = step.recorded
        exact = recorded.checksum is None or recorded.checksum == self._checksum
        self.comparison.exact = self.comparison.exact and exact
        mode, reason, link, source = replayed.status
        recorded_mode, recorded_reason, recorded_link, recorded_source = recorded.status
        pairs: tuple[tuple[Output, object, object], ...] = (
            ("line", replayed.line, recorded.line),
            ("sent line", replayed.sent, recorded.sent),
            ("mode", mode, recorded_mode),
            ("link", link, recorded_link),
            ("source", source, recorded_source),
            ("pose", replayed.poses, recorded.poses),
            ("reason", reason, recorded_reason),
        )
        what = tuple([name for name, new, old in pairs if new != old])
        if replayed.events != recorded.events:
            what += _different_parts(replayed.events, recorded.events)
        if recorded.names not in (None, self._names):
            what += ("input names",)
        if not what:
            return None
        return Difference(step.number, step.inputs.now, what, recorded, replayed, trip)

    def _count(self, step: Step, outputs: Outputs, replayed: RecordedOutputs) -> None:
        comparison, recorded = self.comparison, step.recorded
        comparison.steps += 1
        if recorded.line is not None or replayed.line is not None:
            comparison.lines += 1
            comparison.lines_same += recorded.line == replayed.line
        mode, reason, link, source = map(operator.eq, replayed.status, recorded.status)
        comparison.modes_same += mode
        comparison.reasons_same += reason
        comparison.links_same += link
        comparison.sources_same += source
        for new, old in zip_longest(replayed.events, recorded.events):
            comparison.events += 1
            comparison.events_same += new == old
        comparison.poses += len(recorded.poses)
        pairs = zip(recorded.poses, replayed.poses, strict=False)
        comparison.poses_same += sum(a == b for a, b in pairs)
        recorded_speed, replayed_speed = comparison.fastest
        comparison.fastest = (
            max(recorded_speed, fastest(recorded.line)),
            max(replayed_speed, fastest(replayed.line)),
        )
        if outputs.estimates:
            self._pose = replayed.poses[-1]
        if recorded.poses:
            pose = recorded.poses[-1]
            comparison.end = pose, self._pose
            if pose != self._pose:
                apart = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1]) / MICRO
                comparison.apart = max(comparison.apart, apart)


def _different_parts(
    replayed: tuple[Event, ...], recorded: tuple[Event, ...]
) -> tuple[Output, ...]:
    parts: tuple[tuple[Output, Callable[[Event], object]], ...] = (
        ("event", lambda event: (event.name, event.level, event.kind, event.count, event.news)),
        ("client", lambda event: event.by),
        ("event text", lambda event: event.text),
    )
    return tuple([name for name, part in parts if [*map(part, replayed)] != [*map(part, recorded)]])


@lru_cache(64)
def fastest(line: bytes | None) -> int:
    """Return the highest wheel speed in a line, in hundredths of rad/s; 0 if `line` is None."""
    if line is None:
        return 0
    tokens = [line[start + 2 : start + 7].replace(b".", b"") for start in (0, 8, 16, 24)]
    return max([int(token) for token in tokens if token.isdigit()], default=0)
