"""Replays steps: gives the recorded inputs to a robot, and compares the outputs.

Behavior depends only on inputs and configuration, so the same ones give every line, mode and pose
again. With changed code or configuration, the differences show what would have been. `Replay` does
so for steps, and `Playback` for a recording, whose robot begins at a `Head`.
"""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Literal

from msgspec import Struct, field

from acsard.core.config.parsing import ConfigError, parse_recorded
from acsard.core.config.settings import Config
from acsard.core.guard import Guard, Memory
from acsard.core.robot import Robot
from acsard.core.values import Event, Instant, News, Pose, Trip
from acsard.host.errors import RecordingError
from acsard.recording.file import Failure, Head, ReadRecord, Recording, Unread
from acsard.recording.recorded_steps import (
    US_PER_S,
    Micropose,
    RecordedOutputs,
    RecordedStep,
    checksum,
    micropose,
)
from acsard.recording.state import LayoutError, Restored, StateError, short, thaw

NO_TRIP: Trip = ""

# "sent line" is after the guard, "event" all but text and client.
Output = Literal[
    "line",
    "sent line",
    "mode",
    "link",
    "source",
    "code",
    "pose",
    "event",
    "client",
    "reason",
    "event text",
]


class Difference(Struct, frozen=True):
    number: int  # from 0 at the daemon's start
    at: Instant
    what: tuple[Output, ...]
    recorded: RecordedOutputs
    replayed: RecordedOutputs
    trip: Trip  # why the guard replaced the line with zeros


class Comparison(Struct):
    """The result of a replay so far."""

    steps: int = 0
    # Outputs of the recorded or the replayed robot by their kind, such as "poses", and the equal
    # ones. Of two numbers in a step the larger one counts.
    all: Counter[str] = field(default_factory=Counter)
    equal: Counter[str] = field(default_factory=Counter)
    exact: bool = True  # all poses, twists and wheel angles are equal to the last bit
    first: Difference | None = None  # with any difference
    first_by_output: dict[Output, Difference] = {}
    fault: Difference | None = None  # only the replayed robot is in the mode `fault`
    max_distance_m: float = 0.0  # between positions
    max_wheel_speeds: tuple[int, int] = (0, 0)  # recorded and replayed, 0.01 rad/s
    end: tuple[Micropose, Micropose] | None = None  # last recorded pose, and the replayed one

    @property
    def same(self) -> bool:
        """Whether every output is equal, poses in um and urad."""
        return self.first is None


class Replay:
    def __init__(self, robot: Robot, memory: Memory | None = None) -> None:
        self.news = News()  # of the last step
        self.comparison = Comparison()
        self.resume(robot, memory)
        self._checksum = 0
        self._pose: Micropose = (0, 0, 0)

    def resume(self, robot: Robot, memory: Memory | None) -> None:
        """Go on with another robot, for example after missing steps, and its guard's memory."""
        self.robot = robot
        self._config = robot.config
        self._guard = Guard(robot.link_setup.codec.stop, robot.config, memory)

    def step(self, step: RecordedStep) -> Difference | None:
        """Replay the next step; return how it differs, or None."""
        if step.begins:
            self._checksum = 0
        robot, guard, now, recorded = self.robot, self._guard, step.now, step.recorded
        news = robot.hear(now, step.heard)
        # A step that changes a setting gives the robot a new configuration.
        if robot.config is not self._config:
            self._config = robot.config
            guard.use(self._config)
        line = robot.drive(now) if step.driven else None
        status, sent, trip = robot.status, line, NO_TRIP
        if line is not None:
            sent, trip = guard.check(line, now.mono_ns, status, robot.command_ns)
        if recorded.sent is not None:
            # The board obeyed the recorded line, even if the replayed robot decides another line.
            guard.record_written(recorded.sent)
        else:
            sent = None
        if line is not None:
            # What the recorded guard decided is an input, as the board obeyed it.
            robot.sent(now.mono_ns + step.late_ns, sent, step.trip)
        self.news = news
        self._checksum = checksum(news.estimates, self._checksum)
        poses = tuple([micropose(estimate) for estimate in news.estimates])
        replayed = RecordedOutputs(line, sent, status, poses, news.events)
        difference = self._compare(step, replayed, trip)
        self._count(step, bool(poses), replayed)
        if difference is not None:
            self._keep(difference)
        return difference

    def _keep(self, difference: Difference) -> None:
        comparison = self.comparison
        comparison.first = comparison.first or difference
        for output in difference.what:
            comparison.first_by_output.setdefault(output, difference)
        if difference.replayed.status.mode == "fault" != difference.recorded.status.mode:
            comparison.fault = comparison.fault or difference

    def _compare(
        self, step: RecordedStep, replayed: RecordedOutputs, trip: Trip
    ) -> Difference | None:
        recorded = step.recorded
        exact = recorded.checksum is None or recorded.checksum == self._checksum
        self.comparison.exact = self.comparison.exact and exact
        now, before = replayed.status, recorded.status
        pairs: tuple[tuple[Output, object, object], ...] = (
            ("line", replayed.line, recorded.line),
            ("sent line", replayed.sent, recorded.sent),
            ("mode", now.mode, before.mode),
            ("link", now.link, before.link),
            ("source", now.source, before.source),
            ("code", now.code, before.code),
            ("pose", replayed.poses, recorded.poses),
            ("reason", now.reason, before.reason),
        )
        what = tuple([name for name, new, old in pairs if new != old])
        if replayed.events != recorded.events:
            what += _different_parts(replayed.events, recorded.events)
        if not what:
            return None
        return Difference(step.number, step.now, what, recorded, replayed, trip)

    def _count(self, step: RecordedStep, has_poses: bool, replayed: RecordedOutputs) -> None:
        comparison, recorded = self.comparison, step.recorded
        comparison.steps += 1
        for (kind, new), (_, old) in zip(_outputs(replayed), _outputs(recorded), strict=True):
            comparison.all[kind] += max(len(new), len(old))
            comparison.equal[kind] += sum(map(operator.eq, new, old))
        recorded_speed, replayed_speed = comparison.max_wheel_speeds
        comparison.max_wheel_speeds = (
            max(recorded_speed, max_wheel_speed(recorded.line)),
            max(replayed_speed, max_wheel_speed(replayed.line)),
        )
        if has_poses:
            self._pose = replayed.poses[-1]
        if recorded.poses:
            pose = recorded.poses[-1]
            comparison.end = pose, self._pose
            if pose != self._pose:
                apart = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1]) / US_PER_S
                comparison.max_distance_m = max(comparison.max_distance_m, apart)


def _outputs(outputs: RecordedOutputs) -> Iterator[tuple[str, Sequence[object]]]:
    status = outputs.status
    yield "lines", () if outputs.line is None else (outputs.line,)
    yield "poses", outputs.poses
    yield "modes", (status.mode,)
    yield "reasons", (status.reason,)
    yield "links", (status.link,)
    yield "sources", (status.source,)
    yield "events", outputs.events


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
    """Return the highest wheel speed in a line, in 0.01 rad/s; 0 without a line."""
    if line is None:
        return 0
    tokens = [line[start + 2 : start + 7].replace(b".", b"") for start in (0, 8, 16, 24)]
    return max([int(token) for token in tokens if token.isdigit()], default=0)


# A recording


class Gap(Struct, frozen=True):
    """Steps that are missing in a recording, or that cannot be read."""

    begin: Instant  # last step before it
    end: Instant  # first one after it
    steps: int


class Playback:
    """Replays a recording. After a gap, the robot goes on from the state in the next `Head`."""

    def __init__(self, recording: Recording, other: Config | None = None) -> None:
        # `other` replaces the recorded configuration.
        self.gaps: list[Gap] = []  # found so far
        self.failure: Failure | None = None  # of the recorded daemon, in the last step
        self.head: Head | None = None  # last one that was read
        self.replay: Replay | None = None  # its robot, and the comparison so far
        self._recording, self._other = recording, other
        self._next: int | None = None  # number of the next step; None: of the next head
        self._last: Instant | None = None
        self._waits: Config | None = None  # for a rest, with this configuration
        self._poses: tuple[Micropose, ...] = ()  # the last two, while it waits

    @property
    def robot(self) -> Robot:
        assert self.replay is not None
        return self.replay.robot

    @property
    def comparison(self) -> Comparison:
        return Comparison() if self.replay is None else self.replay.comparison

    def steps(self) -> Iterator[tuple[RecordedStep, News]]:
        """Replay each step in turn, and yield it with its news. Raises `RecordingError`.

        The steps of a frame that precede the time of the recording come, too:
        `Recording.contains` tells them apart.
        """
        for record in self._recording.records():
            if (replayed := self.take(record)) is not None:
                yield replayed

    def take(self, record: ReadRecord) -> tuple[RecordedStep, News] | None:
        """Replay the next record; return a step with its news, or None."""
        match record:
            case Head():
                self._begin(record)
            case Failure():
                self.failure = record
            case RecordedStep(number=number) if number == self._next:
                if self._waits is not None and not self._rests(record):
                    self._next = number + 1
                    return None
                assert self.replay is not None
                with self.errors():
                    self.replay.step(record)
                self._next, self._last = number + 1, record.now
                return record, self.replay.news
        return None

    def _begin(self, head: Head) -> None:
        before, self.head = self.head, head
        same_run = before is not None and before.started_ns == head.started_ns
        if same_run and head.number == self._next:
            return
        if same_run and self._last is not None and self._next is not None:
            at = Instant(head.mono_ns, head.wall_ns)
            self.gaps.append(Gap(self._last, at, head.number - self._next))
        self._next, self._waits = head.number, None
        with self.errors():
            try:
                self._resume(self._robot_at(head))
            except LayoutError:
                self._waits = self._other or config_of(head)
                self._unread = Unread(head.version, head.mono_ns, head.mono_ns)
                self._recording.damage.append(self._unread)

    def _resume(self, restored: Restored) -> None:
        if self.replay is None:
            self.replay = Replay(*restored)
        else:
            self.replay.resume(*restored)

    def _rests(self, step: RecordedStep) -> bool:
        # Whether the recorded robot rests; then a fresh one begins at its pose.
        recorded, config = step.recorded, self._waits
        assert config is not None
        self._unread.end_ns = step.now.mono_ns
        self._poses = (self._poses + recorded.poses)[-2:]
        stays = len(self._poses) == 2 and self._poses[0] == self._poses[1]
        if not (stays and recorded.line and not max_wheel_speed(recorded.line)):
            return False
        robot, self._waits = Robot(config), None
        robot.place(Pose(*(part / US_PER_S for part in self._poses[1])), step.now.mono_ns)
        self._resume(Restored(robot, Memory()))
        return True

    def _robot_at(self, head: Head) -> Restored:
        if head.state:
            return thaw(head.state, self._other)
        return Restored(Robot(self._other or config_of(head)), Memory())

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Raise `RecordingError` for every exception of the robot in a `with` block.

        A forged recording may have any numbers, and so may one of another version.
        """
        try:
            yield
        except RecordingError:
            raise
        except (StateError, ConfigError) as error:
            raise self._error(short(error)) from None
        except Exception as error:
            what = f"it fails with {type(error).__name__}: {short(error)}"
            raise self._error(f"{what} in step {self._next}") from error

    def _error(self, reason: str) -> RecordingError:
        version = "" if self.head is None else f", which acsard {self.head.version} wrote"
        paths = ", ".join([path.name for path in self._recording.paths[:3]])
        return RecordingError(f"this acsard cannot replay {paths}{version}: {reason}")

    def failed_step(self) -> str:
        """Return whether the step in which the daemon failed fails here, too; "" without one."""
        failure, replay = self.failure, self.replay
        if failure is None:
            return ""
        if failure.now is None or failure.heard is None:
            return f"the recorded daemon failed: {failure.why}"
        name = f"step {failure.number}, in which the recorded daemon failed ({failure.why}),"
        if replay is None or self._next != failure.number:
            return f"{name} was not replayed, because the step before it is missing"
        try:
            replay.robot.hear(failure.now, failure.heard)
            replay.robot.drive(failure.now)
        except Exception as error:  # noqa: BLE001 - the failure may be any exception
            return f"{name} also fails here, with {type(error).__name__}: {short(error)}"
        return f"{name} does not fail in this version of acsard"


def config_of(head: Head) -> Config:
    """Return the configuration in force at a head. Raises `ConfigError`."""
    return parse_recorded(head.config.encode())
