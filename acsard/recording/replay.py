"""Replays steps: runs `Robot.step` with the recorded inputs, and compares the outputs.

A robot's behavior depends only on its inputs and its configuration. So the same code with the same
configuration reproduces every line to the board, every mode and every pose. If the code or the
configuration has changed, the differences show how the changed robot would have behaved.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import lru_cache
from itertools import zip_longest
from typing import Literal

from msgspec import Struct

from acsard.core.guard import Guard, Memory
from acsard.core.robot import Robot
from acsard.core.values import Event, Instant, Outputs
from acsard.recording.recorded_steps import (
    US_PER_S,
    Micropose,
    RecordedOutputs,
    RecordedStep,
    checksum,
    count_superseded,
    input_names,
    micropose,
    status_of,
)

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

- line: The line to the board that the robot decided to send.
- sent line: The line that was sent after the guard had checked it.
- event: All properties of an event except its text and its client.
- client: The name of the client that caused an event.
- input names: The names in the inputs of a step. One checksum covers all steps of a batch, so a
  difference is reported at the last step of the batch.
"""

TEXT_OUTPUTS: frozenset[Output] = frozenset({"reason", "event text"})
"""Outputs that are text for people. Another version of acsard may word such a text differently."""


class Difference(Struct, frozen=True):
    """A step whose replayed outputs differ from the recorded outputs."""

    number: int
    """Number of the step. It counts the steps since the daemon's start."""
    at: Instant
    what: tuple[Output, ...]
    """Names of the outputs that differ."""
    recorded: RecordedOutputs
    replayed: RecordedOutputs
    trip: str
    """Why the guard, which checks each line to the board, replaced the replayed line with zeros; ""
    if the guard did not replace it."""


class Comparison(Struct):
    """Result of a replay so far.

    It contains the number of outputs that were compared, the number of outputs that are equal, and
    the first differences.
    """

    steps: int = 0
    lines: int = 0
    """Number of steps in which the recorded robot, the replayed robot or both decided to send a
    line."""
    lines_same: int = 0
    poses: int = 0
    """Number of recorded poses."""
    poses_same: int = 0
    modes_same: int = 0
    reasons_same: int = 0
    links_same: int = 0
    sources_same: int = 0
    events: int = 0
    """Number of compared events. If a step has different numbers of recorded and replayed events,
    the larger number counts."""
    events_same: int = 0
    exact: bool = True
    """True if all poses, twists and wheel angles so far are equal to the last bit. They are
    compared by checksums."""
    first: Difference | None = None
    """First step in which any output differs, or None."""
    first_by_output: dict[Output, Difference] = {}
    """First step in which an output differs, by the name of the output."""
    fault: Difference | None = None
    """First step in which the replayed robot is in the mode `fault` and the recorded robot is not,
    or None."""
    max_distance_m: float = 0.0
    """Largest distance so far between the recorded and the replayed position, m."""
    max_wheel_speeds: tuple[int, int] = (0, 0)
    """Pair: the highest wheel speed in the recorded lines, and the highest wheel speed in the
    replayed lines, both in 0.01 rad/s."""
    end: tuple[Micropose, Micropose] | None = None
    """Pair: the last recorded pose, and the pose of the replayed robot after the step with this
    recorded pose. None before the first recorded pose."""

    @property
    def same(self) -> bool:
        """True if every compared output is equal. Poses are first rounded to um and urad."""
        return self.first is None

    @property
    def only_words(self) -> bool:
        """True if outputs differ, but all differences are in the texts of reasons and events."""
        return not self.same and self.first_by_output.keys() <= TEXT_OUTPUTS


def replay_step(robot: Robot, step: RecordedStep) -> Outputs:
    """Run `robot.step` with the inputs of a recorded step, and return the new outputs.

    Also update the robot's counters `lines_sent`, `lines_superseded` and `commands_superseded`,
    which the daemon's control loop updates while it records.
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

    def __init__(self, robot: Robot, memory: Memory | None = None) -> None:
        """Prepare for the first step. `resume` describes the arguments."""
        self.outputs: Outputs | None = None
        """Outputs of the last replayed step; None before the first step."""
        self.comparison = Comparison()
        self.resume(robot, memory)
        self._checksum = self._names = 0
        self._pose: Micropose = (0, 0, 0)

    def resume(self, robot: Robot, memory: Memory | None) -> None:
        """Replay the next steps with `robot`, for example after missing steps.

        `memory` is the memory of this robot's guard, which checks each line to the board. It is
        None for a new guard.
        """
        self.robot = robot
        self._config = robot.config
        self._guard = Guard(robot.session.codec.stop, robot.config, memory)

    def step(self, step: RecordedStep) -> Difference | None:
        """Replay a step, and update `outputs` and `comparison`.

        Returns the difference between the recorded and the replayed outputs, or None if these
        outputs are equal. The steps must come in order.
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
            # The board obeyed the recorded line, even if the replayed robot decides another line.
            self._guard.record_written(step.recorded.sent)
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
        if difference.replayed.status[0] == "fault" != difference.recorded.status[0]:
            comparison.fault = comparison.fault or difference

    def _compare(
        self, step: RecordedStep, replayed: RecordedOutputs, trip: str
    ) -> Difference | None:
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

    def _count(self, step: RecordedStep, outputs: Outputs, replayed: RecordedOutputs) -> None:
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
        recorded_speed, replayed_speed = comparison.max_wheel_speeds
        comparison.max_wheel_speeds = (
            max(recorded_speed, max_wheel_speed(recorded.line)),
            max(replayed_speed, max_wheel_speed(replayed.line)),
        )
        if outputs.estimates:
            self._pose = replayed.poses[-1]
        if recorded.poses:
            pose = recorded.poses[-1]
            comparison.end = pose, self._pose
            if pose != self._pose:
                apart = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1]) / US_PER_S
                comparison.max_distance_m = max(comparison.max_distance_m, apart)


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
def max_wheel_speed(line: bytes | None) -> int:
    """Return the highest absolute wheel speed in a line to the board, in 0.01 rad/s.

    Returns 0 without a line.
    """
    if line is None:
        return 0
    tokens = [line[start + 2 : start + 7].replace(b".", b"") for start in (0, 8, 16, 24)]
    return max([int(token) for token in tokens if token.isdigit()], default=0)
