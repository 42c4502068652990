"""Replays a recording file, from its first step to its end or to the first missing step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.settings import Config
from acsard.core.formatting import many
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.values import Outputs
from acsard.host.errors import RecordingError
from acsard.recording.event_copies import EventCopies
from acsard.recording.file import Recording
from acsard.recording.merge import adopt
from acsard.recording.recorded_steps import Step, UnfinishedError, unfinished
from acsard.recording.replay import Comparison, Replay
from acsard.recording.rows import BatchError, decode
from acsard.recording.state import State, StateError, short, thaw

Progress = Callable[[int], None]
"""Callback that takes the wall-clock time which the replay has reached, ns since 1970."""

PROGRESS_STEPS = 1024
"""Number of replayed steps between two calls of the progress callback."""


def no_progress(wall_ns: int) -> None:
    """Do nothing. This is the callback of a caller that shows no progress."""


INCOMPLETE_STATE_ERRORS = (
    AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RecursionError
)  # fmt: skip
"""Exceptions that a robot raises if its recorded state lacks parts that this version expects."""


class ReplayResult(NamedTuple):
    """Result of the replay of a file."""

    comparison: Comparison
    trouble: str
    """Why the replay ended before the end of the file; "" if it is complete."""
    failed_step: str = ""
    """Sentence that says whether the step in which the daemon failed fails in this version too.

    It is "" if the daemon did not fail.
    """
    event_copies: str = ""
    """Sentence about the first copy of an event that differs from its step; "" if none does."""

    @property
    def same(self) -> bool:
        """True if all outputs of the replay are equal, and all copies of the events."""
        return self.comparison.same and not self.event_copies


def config_of(recording: Recording) -> Config:
    """Return the configuration of a recording.

    Raises `RecordingError` if this version cannot read the configuration.
    """
    try:
        return parse(recording.about.config.encode())
    except ConfigError as error:
        raise RecordingError(
            f"this version cannot use the configuration in {recording.path}: {error}"
        ) from None


def steps(recording: Recording, copies: EventCopies | None = None) -> Iterator[Step]:
    """Yield every step that can be read, in order. The numbers of the steps show the gaps.

    `copies` takes the same steps and the copies of their events.
    """
    for topic, _, data in recording.messages():
        if topic == "events" and copies is not None:
            copies.copy(data)
        if topic == "steps":
            try:
                batch = decode(data)
            except BatchError:
                recording.damaged += 1
                continue
            if copies is not None:
                copies.batch(batch)
            yield from batch


class RecordedRun:
    """The steps of a recording up to the first gap, and the robot as it was before them."""

    def __init__(self, recording: Recording, other: Config | None = None) -> None:
        """Use the configuration `other`, or the recording's own if `other` is None.

        Raises `RecordingError` if this version cannot read the recorded configuration or state.
        """
        self.config = other or config_of(recording)
        """Configuration of the first step."""
        self.trouble = ""
        """Why `steps` ended before the end of the file; "" if it did not."""
        self.number: int | None = None
        """Number of the last step that `steps` yielded."""
        self.copies = EventCopies(recording)
        """The copies of the events of the steps that `steps` yielded."""
        self._recording = recording
        self._state, new_robot = _state(recording), Robot(self.config)
        self.robot, self.memory = self._state or (new_robot, Memory())
        if self._state is not None:
            # A state recorded by other code may lack parts that this version has. Those parts are
            # taken from a new robot.
            recorded_new_robot = Robot(config_of(recording))
            with self.state_errors():
                adopt(self.robot, recorded_new_robot, new_robot)

    @contextmanager
    def state_errors(self) -> Iterator[None]:
        """Raise `RecordingError` if the recorded state lacks a part that the block uses.

        Wrap every use of `robot` in this context.
        """
        with _state_errors(self._recording, self._state):
            yield

    def steps(self) -> Iterator[Step]:
        """Yield the steps until one is missing.

        Raises `RecordingError` if the first steps are missing, or if no step can be read.
        """
        path = self._recording.path
        for step in steps(self._recording, self.copies):
            number = self.number
            if number is None and self._state is None and step.number > 0:
                raise RecordingError(f"{path}: its first steps are missing or damaged")
            if number is not None and step.number != number + 1:
                missing = step.number - number - 1
                self.trouble = (
                    f"{many(missing, 'step is', 'steps are')} missing after step {number}"
                )
                return
            self.number = step.number
            yield step
        if self.number is None:
            raise RecordingError(f"{path} has no steps: it ends within its first second")
        self.copies.end()


def replay_file(
    recording: Recording, other: Config | None = None, progress: Progress = no_progress
) -> ReplayResult:
    """Replay a recording with the configuration `other`, or with its own if `other` is None.

    Raises `RecordingError` if this version cannot replay the recording.
    """
    run = RecordedRun(recording, other)
    with run.state_errors():
        replay = Replay(run.config, run.robot, run.memory)
        for number, step in enumerate(run.steps()):
            if number % PROGRESS_STEPS == 0:
                progress(step.inputs.now.wall_ns)
            replay.step(step)
    failed_step = "" if run.trouble else _failed_step(recording, replay.robot, run.number)
    return ReplayResult(replay.comparison, run.trouble, failed_step, run.copies.difference)


def _failed_step(recording: Recording, robot: Robot, last: int | None) -> str:
    """Run the step in which the daemon failed, and say whether this version fails too.

    `robot` is the replayed robot after the step with the number `last`. The failed step must be
    the next one.
    """
    if recording.unfinished is None:
        return ""
    try:
        step = unfinished(recording.unfinished)
    except UnfinishedError as error:
        return str(error)
    name = f"step {step.number}, which ended the daemon,"
    if last is None or step.number != last + 1:
        return f"{name} does not follow the previous step"
    try:
        robot.step(step.inputs)
    except Exception as error:  # noqa: BLE001 - the failure may be any exception
        return f"{name} ends this version too, by {type(error).__name__}: {short(error)}"
    return f"{name} does not end the robot of this version"


class DisplayReplay:
    """Replay of a recording for display, which goes on after missing steps."""

    def __init__(self, recording: Recording) -> None:
        """Read the recording; raise `RecordingError` if its configuration cannot be read."""
        self._recording = recording
        self.notes: list[str] = []
        """Notes for the user about how this replay may differ from the recorded drive."""
        self.config = config_of(recording)
        try:
            self._state = _state(recording)
            with self.state_errors():
                if self._state is not None:
                    adopt(self._state.robot, Robot(self.config), Robot(self.config))
                self.replay = Replay(self.config, *(self._state or ()))
        except RecordingError as error:
            self._state, self.replay = None, Replay(self.config)
            self.notes.append(
                "the replay begins with a new robot, which knows nothing of the "
                f"time before: {error}"
            )

    @contextmanager
    def state_errors(self) -> Iterator[None]:
        """Raise `RecordingError` if the recorded state lacks a part that the block uses.

        Wrap every use of the robot in this context.
        """
        with _state_errors(self._recording, self._state):
            yield

    def steps(self) -> Iterator[tuple[Step, Outputs, Robot]]:
        """Yield each recorded step, its replayed outputs, and the robot after the step.

        Raises `RecordingError` if the recorded state lacks a part that a step uses.
        """
        first = True
        for step in steps(self._recording):
            if first and self._state is None and step.number > 0 and not self.notes:
                self.notes.append("its first steps are missing: the replay begins without them")
            first = False
            with self.state_errors():
                self.replay.step(step)
            if self.replay.outputs is not None:
                yield step, self.replay.outputs, self.replay.robot


def _state(recording: Recording) -> State | None:
    """Return the robot's state before the first step, or None if the file holds no state."""
    for topic, _, data in recording.messages():
        if topic == "state":
            try:
                return thaw(data)
            except StateError as error:
                raise _foreign(recording, str(error)) from None
        if topic == "steps":
            return None
    return None


@contextmanager
def _state_errors(recording: Recording, state: State | None) -> Iterator[None]:
    """Raise `RecordingError` if the block fails because the recorded state is incomplete.

    The state may come from other code or a forged file, so any part of the robot may be missing or
    of a wrong type. Without a recorded state, an error of the block is a defect of this version and
    is raised as it is.
    """
    try:
        yield
    except RecordingError:
        raise
    except INCOMPLETE_STATE_ERRORS as error:
        if state is None:
            raise
        reason = f"this version cannot read the state at its start: {short(error)}"
        raise _foreign(recording, reason) from error


def _foreign(recording: Recording, reason: str) -> RecordingError:
    return RecordingError(
        f"{recording.path}: {reason}; it was recorded by acsard {recording.about.version}, whose "
        "replay can read it"
    )
