"""Replays a recording, and checks the copies of the events in the recording.

A file has each event in its step and in the channel `events`. After a damaged place, the replay
resumes at the next robot state, and the steps before it cannot be replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import zip_longest
from typing import NamedTuple

from msgspec import Struct

from acsard.core.config.live import changed, flat
from acsard.core.config.parsing import ConfigError, effective, parse, parse_recorded
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.values import Ns, WallNs
from acsard.host.errors import RecordingError
from acsard.recording.end_record import read_end
from acsard.recording.mcap_file import Recording, event_of
from acsard.recording.mcap_timeline import TimelineEntry, entry_of
from acsard.recording.recorded_steps import RecordedStep, UnfinishedError, unfinished
from acsard.recording.replay import Comparison, Replay
from acsard.recording.rows import BatchError, decode
from acsard.recording.state import Checkpoint, State, StateError, adopt, checkpoint, short, thaw
from acsard.recording.stepped_robot import SteppedRobot
from acsard.recording.unpickling import MAX_BYTES

Progress = Callable[[int], None]  # shows the progress, by the present wall-clock time, ns

PROGRESS_STEPS = 1024  # between two calls of it


def no_progress(wall_ns: WallNs) -> None:
    """Do nothing: the default `Progress`."""


# Raised by a `Robot` from an incomplete recorded state.
INCOMPLETE_STATE_ERRORS = (
    AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RecursionError
)  # fmt: skip


class Gap(Struct):
    """Part of a recording that is not replayed: from unreadable steps to the next robot state."""

    begin_ns: Ns  # last replayed step before it, or the beginning
    end_ns: Ns  # first replayed step after it, or the end
    unreadable: int = 0  # by the step numbers
    skipped: int = 0  # readable steps before the next robot state
    lines: int = 0  # of `skipped`, with a line to the board
    end_lost: bool = False  # the last steps of the recording are unreadable


class ReplayResult(NamedTuple):
    comparison: Comparison
    gaps: list[Gap]  # not compared
    # Whether the step in which the daemon failed fails here, too; "": it did not fail.
    failed_step: str = ""
    event_copies: str = ""  # about the first event that differs from its copy, or ""

    @property
    def same(self) -> bool:
        """Whether all outputs equal the recorded ones, and all events their copies."""
        return self.comparison.same and not self.event_copies


def config_of(recording: Recording) -> Config:
    """Return the configuration at the beginning of a recording. Raises `RecordingError`."""
    try:
        return parse_recorded(recording.about.config.encode())
    except ConfigError as error:
        raise RecordingError(
            "this version of acsard cannot use the configuration in the recording "
            f"{recording.path}: {error}; acsard {recording.about.version}, which made the "
            "recording, can use the configuration"
        ) from None


def steps(recording: Recording) -> Iterator[RecordedStep]:
    """Yield every readable step in order. Steps are missing where their numbers jump."""
    for step, _ in _steps_and_states(recording):
        yield step


def _steps_and_states(
    recording: Recording, copies: EventCopies | None = None
) -> Iterator[tuple[RecordedStep, Checkpoint | None]]:
    # Each step comes with the last robot state before it.
    saved: Checkpoint | None = None
    for topic, _, data in recording.messages():
        if topic == "events" and copies is not None:
            copies.copy(data)
        try:
            saved = checkpoint(data) if topic == "state" else saved
            batch = decode(data) if topic == "steps" else []
        except (BatchError, StateError):
            recording.damaged += 1
            continue
        if batch and copies is not None:
            copies.batch(batch)
        for step in batch:
            yield step, saved


# Without this limit, the replay of a forged file of 5 kB took 4 s.
STATE_BYTES_PER_FILE_BYTE = 8  # decoded after gaps, plus `MAX_BYTES`


class _Source:
    # Decodes recorded states of the robot.
    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._state: State | None = None  # from which the replay last started; None: a new robot
        self._place = "at the start of"  # position of `_state`, for messages
        self._state_bytes_left = MAX_BYTES  # to be decoded after gaps
        for path in recording.paths:
            # The reader of the steps reports a missing file later.
            with suppress(OSError):
                self._state_bytes_left += STATE_BYTES_PER_FILE_BYTE * path.stat().st_size

    @contextmanager
    def state_errors(self) -> Iterator[None]:
        """Raise `RecordingError` for what an incomplete robot state causes in a `with` block.

        A forged recording may lack parts, so every use of the robot is in such a block.
        """
        try:
            yield
        except RecordingError:
            raise
        except INCOMPLETE_STATE_ERRORS as error:
            # Without a recorded state, the error is a defect in the code.
            if self._state is None:
                raise
            reason = (
                f"this version of acsard cannot read the robot state {self._place} the recording: "
                f"{short(error)}"
            )
            raise _foreign(self._recording, reason) from error

    def _resumed(
        self,
        saved: Checkpoint | None,
        number: int,
        tried: Callable[[Config], Config] | None = None,
    ) -> State | None:
        # None if it is not usable or of another step.
        if saved is None or saved.number != number:
            return None
        self._state_bytes_left -= len(saved.data)
        if self._state_bytes_left < 0:
            return None
        try:
            state = thaw(saved.data)
            # A forged configuration may have values that no robot can work with.
            present = parse("\n".join(document(effective(state.robot.config))).encode())
            adopt(state.robot, Robot(present), Robot(tried(present) if tried else present))
        except (StateError, ConfigError, *INCOMPLETE_STATE_ERRORS):
            return None
        self._place = f"before step {number} of"
        return state


class RecordedRun(_Source):
    """The steps of a recording that can be replayed, and a robot that can replay them.

    Replay each step of `steps()` with `robot` before the next. After missing steps, it is another
    one.
    """

    def __init__(
        self,
        recording: Recording,
        other: Config | None = None,
        copies: EventCopies | None = None,
    ) -> None:
        # `other` replaces the recorded configuration. `copies` gets both copies of each event; call
        # its `end()` after the last step. Raises `RecordingError`.
        super().__init__(recording)
        self._other, self._recorded, self._copies = other, config_of(recording), copies
        config = other or self._recorded
        self.gaps: list[Gap] = []  # found so far
        self.number: int | None = None  # of the last step
        # Gets each step that can be read, but not replayed.
        self.on_skipped: Callable[[RecordedStep], None] = lambda step: None
        # Next step, and the state of the robot, or None.
        self._next, self._state = _first_state(recording)
        # The robot, with the memory of its guard.
        robot, self.memory = self._state or (Robot(config), Memory())
        self.stepped = SteppedRobot(robot)
        if self._state is not None:
            with self.state_errors():
                adopt(self.robot, Robot(self._recorded), Robot(config))

    @property
    def robot(self) -> Robot:
        return self.stepped.robot

    def steps(self) -> Iterator[RecordedStep]:
        """Yield the steps that can be replayed. Raises `RecordingError` if there are none."""
        recording = self._recording
        replayed_ns = recording.about.mono_ns
        read, damaged = self._next, 0
        last: RecordedStep | None = None
        gap: Gap | None = None
        for step, saved in _steps_and_states(recording, self._copies):
            damaged, now_ns = recording.damaged, step.inputs.now.mono_ns
            missing, read = step.number - read, step.number + 1
            if gap is None and (missing or (last is None and now_ns > replayed_ns)):
                gap = self._open_gap(replayed_ns)
            last = step
            known = step.number == self._next or self._resume(saved, step.number)
            if gap is not None:
                gap.end_ns = max(gap.end_ns, now_ns)
                gap.unreadable += max(0, missing)
                if not known:
                    gap.skipped += 1
                    gap.lines += step.recorded.line is not None
                    self.on_skipped(step)
                    continue
                gap = None
            self.number, self._next, replayed_ns = step.number, step.number + 1, now_ns
            yield step
        if last is None:
            raise RecordingError(
                f"{recording.path} has no readable steps, because it ends within its first second "
                "or its steps are damaged: choose another recording"
            )
        if self.number is None:
            raise RecordingError(
                f"{recording.path} cannot be replayed: its first steps are missing or damaged, and "
                "no readable state of the robot follows them"
            )
        if recording.damaged > damaged:
            end, now = read_end(recording.paths[-1]), last.inputs.now
            lost_ns = 0 if end is None else end.last_ns - now.wall_ns
            # If the end of the file is unreadable, it may have had more steps.
            if end is None or lost_ns > 0:
                gap = gap or self._open_gap(replayed_ns)
                gap.end_ns, gap.end_lost = max(gap.end_ns, now.mono_ns) + lost_ns, True

    def _open_gap(self, begin_ns: Ns) -> Gap:
        gap = Gap(begin_ns, begin_ns)
        self.gaps.append(gap)
        return gap

    def _resume(self, saved: Checkpoint | None, number: int) -> bool:
        other = self._other
        tried = None if other is None else partial(_with_changes, other, self._recorded)
        state = self._resumed(saved, number, tried)
        if state is None:
            return False
        self._state = state
        robot, self.memory = state
        self.stepped = SteppedRobot(robot)
        return True


def _with_changes(other: Config, recorded: Config, present: Config) -> Config:
    # A robot with the configuration `other` would have refused changes that are not permitted.
    before = dict(flat(effective(recorded)))
    changes = {k: v for k, v in flat(effective(present)) if before.get(k) != v}
    try:
        return changed(other, changes, at_rest=True)[0]
    except ConfigError:
        return other


def replay_file(
    recording: Recording, other: Config | None = None, progress: Progress = no_progress
) -> ReplayResult:
    """Replay a recording and compare its outputs, maybe with an `other` configuration.

    Raises `RecordingError` if it cannot be replayed.
    """
    copies = EventCopies(recording)
    run = RecordedRun(recording, other, copies)
    with run.state_errors():
        replay = Replay(run.robot, run.memory)
        for number, step in enumerate(run.steps()):
            if number % PROGRESS_STEPS == 0:
                progress(step.inputs.now.wall_ns)
            if replay.robot is not run.robot:
                replay.resume(run.robot, run.memory)
            replay.step(step)
    copies.end()
    failed_step = _failed_step(recording, replay.stepped, run.number)
    return ReplayResult(replay.comparison, run.gaps, failed_step, copies.difference)


def _failed_step(recording: Recording, robot: SteppedRobot, last: int | None) -> str:
    # After the last message; `last` is the last step that `robot` has replayed.
    if recording.unfinished is None:
        return ""
    try:
        step = unfinished(recording.unfinished)
    except UnfinishedError as error:
        return str(error)
    name = f"step {step.number}, in which the recorded daemon failed,"
    if last is None or step.number != last + 1:
        return f"{name} was not replayed, because the step before it is missing"
    try:
        robot.step(step.inputs)
    except Exception as error:  # noqa: BLE001 - the failure may be any exception
        return (
            f"{name} also fails in this version of acsard, with {type(error).__name__}: "
            f"{short(error)}"
        )
    return f"{name} does not fail in this version of acsard"


def _first_state(recording: Recording) -> tuple[int, State | None]:
    # The number of the next step and the state; (0, None) without one. Raises `RecordingError`.
    for topic, _, data in recording.messages():
        if topic == "state":
            try:
                saved = checkpoint(data)
                return saved.number, thaw(saved.data)
            except StateError as error:
                raise _foreign(recording, str(error)) from None
        if topic == "steps":
            break
    return 0, None


def _foreign(recording: Recording, reason: str) -> RecordingError:
    return RecordingError(
        f"{recording.path}: {reason}. If the file is neither damaged nor forged, the version that "
        f"made it can replay it: acsard {recording.about.version}"
    )


class EventCopies:
    """Finds the first event in one file, not a `Series`, that differs from its copy.

    Call `batch()` and `copy()` in the order of the file, and then `end()`.
    """

    def __init__(self, recording: Recording) -> None:
        self.difference = ""  # about that event, or ""
        self._recording = recording
        self._events: list[TimelineEntry] = []  # of the last batch
        self._copies: list[TimelineEntry] = []  # since the last batch
        self._number: int | None = None  # of the step after the last batch
        self._damaged = 0  # `Recording.damaged` at the last batch

    def batch(self, steps: list[RecordedStep]) -> None:
        """Process the next batch of steps, and compare the previous one with its copies."""
        self._compare(last=False, follows=self._number in (None, steps[0].number))
        self._number, self._damaged = steps[-1].number + 1, self._recording.damaged
        self._events = [
            entry_of(event, step.inputs.now.wall_ns)
            for step in steps
            for event in step.recorded.events
        ]
        self._copies = []

    def copy(self, data: bytes) -> None:
        """Process a message of the channel `events`, a copy in the previous batch."""
        try:
            self._copies.append(event_of(self._recording, data))
        except RecordingError as error:
            self._differs(str(error))

    def end(self) -> None:
        """Compare the last batch, and the end record of a finished and undamaged file."""
        recording = self._recording
        self._compare(last=True)
        if self.difference or not recording.is_intact:
            return
        end = read_end(recording.path)
        summary = recording.compute_end_record().said
        if end is not None and end.said != summary:
            self._differs(
                f'the summary at the end of the file is "{end.said}", but the events in the file '
                f'give the summary "{summary}"'
            )

    def _compare(self, last: bool, follows: bool = True) -> None:
        # Copies may be missing after the `last` batch of a cut file; `follows` is false before
        # missing steps, where nothing is compared.
        recording = self._recording
        if recording.damaged > self._damaged or not follows:
            return
        # Copies may be missing at the end of a file that was cut off.
        missing = last and bool(recording.cut or not recording.ended)
        for event, copy in zip_longest(self._events, self._copies):
            if event != copy:
                if copy is not None or not missing:
                    self._differs(
                        f"the file has two versions of an event: {_entry_text(event)} in a step, "
                        f"but {_entry_text(copy)} in the channel `events`"
                    )
                return

    def _differs(self, sentence: str) -> None:
        self.difference = self.difference or printable(sentence)


def _entry_text(entry: TimelineEntry | None) -> str:
    if entry is None:
        return "nothing"
    by = f" (by {entry.by})" if entry.by else ""
    return f'"{entry.name}: {entry.text}{by}"'
