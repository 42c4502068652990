"""Replays a recording file. After damage, it goes on at the next state of the robot in the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import zip_longest
from typing import NamedTuple

from msgspec import Struct

from acsard.core.config.live import changed, flat
from acsard.core.config.parsing import ConfigError, effective, parse
from acsard.core.config.settings import Config
from acsard.core.config.writing import document
from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.values import Outputs
from acsard.host.errors import RecordingError
from acsard.recording.end_record import read_end
from acsard.recording.file import Recording, event_of
from acsard.recording.recorded_steps import Step, UnfinishedError, unfinished
from acsard.recording.replay import Comparison, Replay
from acsard.recording.rows import BatchError, decode
from acsard.recording.state import Checkpoint, State, StateError, adopt, checkpoint, short, thaw
from acsard.recording.timeline import TimelineEntry, entry_of
from acsard.recording.unpickling import MAX_BYTES

Progress = Callable[[int], None]
"""Callback that takes the wall-clock time which the replay has reached, ns since 1970."""

PROGRESS_STEPS = 1024
"""Number of replayed steps between two calls of the progress callback."""


def no_progress(wall_ns: int) -> None:
    """Do nothing. This is the callback of a caller that shows no progress."""


INCOMPLETE_STATE_ERRORS = (
    AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RecursionError
)  # fmt: skip
"""Exceptions that the robot's code raises if its recorded state lacks parts that it expects."""


class Gap(Struct):
    """A part that is not replayed: from unreadable steps to the next state of the robot."""

    begin_ns: int
    """Monotonic time of the last replayed step before the gap, ns."""
    end_ns: int
    """Monotonic time of the first replayed step after the gap, or of the recording's end, ns."""
    unreadable: int = 0
    """Number of steps that cannot be read, as far as the step numbers show it."""
    skipped: int = 0
    """Number of readable steps before the next state of the robot, which are not replayed."""
    lines: int = 0
    """Number of lines to the board in the skipped steps."""
    end_lost: bool = False
    """True if the last steps of the recording cannot be read."""


class ReplayResult(NamedTuple):
    comparison: Comparison
    gaps: list[Gap]
    """The parts of the file that are not compared."""
    failed_step: str = ""
    """Sentence that says whether this version fails in the same step as the recorded daemon; "" if
    the daemon did not fail."""
    event_copies: str = ""
    """Sentence about the first event that differs from its copy in the channel `events`, or ""."""

    @property
    def same(self) -> bool:
        """True if the replayed outputs equal the recorded ones, and all copies of events agree."""
        return self.comparison.same and not self.event_copies


def config_of(recording: Recording) -> Config:
    """Return a recording's configuration; raise `RecordingError` if this version cannot read it."""
    try:
        return parse(recording.about.config.encode())
    except ConfigError as error:
        raise RecordingError(
            f"this version cannot use the configuration in {recording.path}: {error}; acsard "
            f"{recording.about.version}, which recorded it, can"
        ) from None


def steps(recording: Recording) -> Iterator[Step]:
    """Yield every step that can be read, in order. The numbers of the steps show the gaps."""
    for item in _items(recording):
        if not isinstance(item, Checkpoint):
            yield from item


def _items(
    recording: Recording, copies: EventCopies | None = None
) -> Iterator[list[Step] | Checkpoint]:
    """Yield the batches of steps and the states of the robot. Pass steps and events to `copies`."""
    for topic, _, data in recording.messages():
        if topic == "events" and copies is not None:
            copies.copy(data)
        try:
            if topic == "state":
                yield checkpoint(data)
            elif topic == "steps":
                batch = list(decode(data))
                if copies is not None:
                    copies.batch(batch)
                yield batch
        except (BatchError, StateError):
            recording.damaged += 1


MAX_STATE_BYTES = 8
"""Total size of the states that may be decoded after gaps, in bytes per byte of the file.
`MAX_BYTES` are allowed in addition. A genuine file stays below this limit. Without the limit, the
replay of a forged file of 5 kB took 4 s."""


class _Source:
    """A recording that is replayed, and the last robot that was decoded from it."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._state: State | None = None
        """The last robot that was decoded from the file; None if the replay uses a new one."""
        self._left = MAX_BYTES
        """Total size of the states that may still be decoded after gaps, bytes."""
        for path in recording.paths:
            # The reader of the steps reports a missing file later.
            with suppress(OSError):
                self._left += MAX_STATE_BYTES * path.stat().st_size

    @contextmanager
    def state_errors(self) -> Iterator[None]:
        """Raise `RecordingError` if the block fails because the recorded state is incomplete.

        Wrap every use of the robot in this context, because a forged state may lack any part. If
        the robot is not from the file, an error of the block is a defect and is raised as it is.
        """
        try:
            yield
        except RecordingError:
            raise
        except INCOMPLETE_STATE_ERRORS as error:
            if self._state is None:
                raise
            reason = f"this version cannot read the state at its start: {short(error)}"
            raise _foreign(self._recording, reason) from error

    def _resumed(
        self,
        saved: Checkpoint | None,
        number: int,
        tried: Callable[[Config], Config] | None = None,
    ) -> State | None:
        """Decode the robot in `saved` if it was saved just before the step `number`.

        Return None if it was not, if this version cannot read the robot, or if the states decoded
        after gaps exceed their limit in size. `tried` takes the configuration of the decoded robot,
        and returns the configuration that replaces it.
        """
        if saved is None or saved.number != number:
            return None
        self._left -= len(saved.data)
        if self._left < 0:
            return None
        try:
            state = thaw(saved.data)
            # A forged configuration may have values that no robot can work with.
            present = parse("\n".join(document(effective(state.robot.config))).encode())
            adopt(state.robot, Robot(present), Robot(tried(present) if tried else present))
        except (StateError, ConfigError, *INCOMPLETE_STATE_ERRORS):
            return None
        return state


class RecordedRun(_Source):
    """The steps of a recording that can be replayed, and the robot as it was before each of them.

    If steps are missing, the run goes on with the next state of the robot in the file.
    """

    def __init__(self, recording: Recording, other: Config | None = None) -> None:
        """Use the configuration `other`, or the recording's own if `other` is None.

        Raises `RecordingError` if this version cannot read the recorded configuration or state.
        """
        super().__init__(recording)
        self._other, self._recorded = other, config_of(recording)
        self.config = other or self._recorded
        """Configuration with which the replay begins."""
        self.gaps: list[Gap] = []
        """The gaps that were found so far."""
        self.number: int | None = None
        """Number of the last step that `steps` yielded; None before the first."""
        self.skipped: Callable[[Step], None] = lambda step: None
        """Called with each step that can be read but not replayed."""
        self.copies = EventCopies(recording)
        self._next, self._state = _first_state(recording)
        """Number of the step that `robot` can replay next; recorded robot, None for a new robot."""
        self.robot, self.memory = self._state or (Robot(self.config), Memory())
        """The robot with which to replay, and its guard's memory. Both are replaced after a gap."""
        if self._state is not None:
            with self.state_errors():
                adopt(self.robot, Robot(self._recorded), Robot(self.config))

    def steps(self) -> Iterator[Step]:
        """Yield the steps that can be replayed; raise `RecordingError` if there is none."""
        recording = self._recording
        replayed_ns = recording.about.mono_ns
        read, damaged = self._next, 0
        saved: Checkpoint | None = None
        last: Step | None = None
        gap: Gap | None = None
        for item in _items(recording, self.copies):
            if isinstance(item, Checkpoint):
                saved = item
                continue
            damaged = recording.damaged
            for step in item:
                now_ns = step.inputs.now.mono_ns
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
                        self.skipped(step)
                        continue
                    gap = None
                self.number, self._next, replayed_ns = step.number, step.number + 1, now_ns
                yield step
        if last is None:
            raise RecordingError(
                f"{recording.path} has no steps, because it ends within its first second: choose "
                "another recording"
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
        self.copies.end()

    def _open_gap(self, begin_ns: int) -> Gap:
        gap = Gap(begin_ns, begin_ns)
        self.gaps.append(gap)
        return gap

    def _resume(self, saved: Checkpoint | None, number: int) -> bool:
        """Continue with the robot in `saved` before the step `number`; return False if it fails."""
        other = self._other
        tried = None if other is None else partial(_with_changes, other, self._recorded)
        state = self._resumed(saved, number, tried)
        if state is None:
            return False
        self._state = state
        self.robot, self.memory = state
        return True


def _with_changes(other: Config, recorded: Config, present: Config) -> Config:
    """Return `other` with the settings that changed from `recorded` to `present`.

    If `other` forbids these changes, return `other`, because its robot would have refused them.
    """
    before = dict(flat(effective(recorded)))
    changes = {k: v for k, v in flat(effective(present)) if before.get(k) != v}
    try:
        return changed(other, changes, at_rest=True)[0]
    except ConfigError:
        return other


def replay_file(
    recording: Recording, other: Config | None = None, progress: Progress = no_progress
) -> ReplayResult:
    """Replay a recording with the configuration `other`, or with its own if `other` is None.

    Calls `progress` every `PROGRESS_STEPS` steps. Raises `RecordingError` if the replay fails.
    """
    run = RecordedRun(recording, other)
    with run.state_errors():
        replay = Replay(run.config, run.robot, run.memory)
        for number, step in enumerate(run.steps()):
            if number % PROGRESS_STEPS == 0:
                progress(step.inputs.now.wall_ns)
            if replay.robot is not run.robot:
                replay.resume(run.robot, run.memory)
            replay.step(step)
    failed_step = _failed_step(recording, replay.robot, run.number)
    return ReplayResult(replay.comparison, run.gaps, failed_step, run.copies.difference)


def _failed_step(recording: Recording, robot: Robot, last: int | None) -> str:
    """Run the step in which the daemon failed; return `ReplayResult.failed_step`.

    `robot` is the robot after the step with the number `last`. The failed step must be the next.
    """
    if recording.unfinished is None:
        return ""
    try:
        step = unfinished(recording.unfinished)
    except UnfinishedError as error:
        return str(error)
    name = f"step {step.number}, which ended the daemon,"
    if last is None or step.number != last + 1:
        return f"{name} was not replayed, because the step before it is missing"
    try:
        robot.step(step.inputs)
    except Exception as error:  # noqa: BLE001 - the failure may be any exception
        return f"{name} ends this version too, with {type(error).__name__}: {short(error)}"
    return f"{name} does not end this version"


class DisplayReplay(_Source):
    """Replay of a recording for display.

    After missing steps, the replayed robot may be wrong until the next state in the file.
    """

    def __init__(self, recording: Recording) -> None:
        """Read the recording; raise `RecordingError` if its configuration cannot be read."""
        super().__init__(recording)
        self.notes: list[str] = []
        """Notes for the user about how this replay may differ from the recorded drive."""
        self.config = config_of(recording)
        self._in_gap = False
        """True from a missing step to the next state of the robot."""
        try:
            _, self._state = _first_state(recording)
            with self.state_errors():
                if self._state is not None:
                    adopt(self._state.robot, Robot(self.config), Robot(self.config))
                self.replay = Replay(self.config, *(self._state or ()))
        except RecordingError as error:
            self._state, self.replay = None, Replay(self.config)
            self.notes.append(
                "the replay begins with a robot that has just started, which may differ from the "
                f"recorded robot: {error}"
            )

    def steps(self) -> Iterator[tuple[Step, Outputs, Robot]]:
        """Yield each recorded step, its replayed outputs, and the robot after the step.

        Raises `RecordingError` if the recorded state lacks a part that a step uses.
        """
        saved: Checkpoint | None = None
        number: int | None = None
        for item in _items(self._recording):
            if isinstance(item, Checkpoint):
                saved = item
                continue
            for step in item:
                if number is None and self._state is None and step.number > 0 and not self.notes:
                    note = "its first steps are missing: the replay begins without them"
                    self.notes.append(note)
                if number is not None and step.number != number + 1:
                    self._in_gap = True
                number = step.number
                if self._in_gap and (state := self._resumed(saved, number)) is not None:
                    self._state, self._in_gap = state, False
                    self.replay.resume(*state)
                with self.state_errors():
                    self.replay.step(step)
                if self.replay.outputs is not None:
                    yield step, self.replay.outputs, self.replay.robot


def _first_state(recording: Recording) -> tuple[int, State | None]:
    """Return the number of the first step, and the recorded robot before that step.

    Returns 0 and None if the recording has no state before its first step. Raises `RecordingError`
    if the state is damaged, or if this version cannot read it.
    """
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
        f"{recording.path}: {reason}; it was recorded by acsard {recording.about.version}, whose "
        "replay can read it"
    )


class EventCopies:
    """Finds the first copy of an event that differs from the event of its step.

    A file has each event twice: in its step, and as a message of the channel `events`. Call `batch`
    for each batch of steps and `copy` for each of these messages, in the order of the file, and
    `end` after the last message.
    """

    def __init__(self, recording: Recording) -> None:
        self.difference = ""
        """Sentence about the first copy that differs, or "" if all copies are equal."""
        self._recording = recording
        self._events: list[TimelineEntry] = []
        self._copies: list[TimelineEntry] = []
        self._number: int | None = None
        """Number of the step that follows the last batch."""
        self._damaged = 0
        """Number of damaged places before the last batch."""

    def batch(self, steps: list[Step]) -> None:
        """Compare the copies of the previous batch, and store the events of a new batch."""
        self._compare(last=False, follows=self._number in (None, steps[0].number))
        self._number, self._damaged = steps[-1].number + 1, self._recording.damaged
        self._events = [
            entry_of(event, step.inputs.now.wall_ns)
            for step in steps
            for event in step.recorded.events
        ]
        self._copies = []

    def copy(self, data: bytes) -> None:
        """Add a message of the channel `events`, the copy of an event in the last batch."""
        try:
            self._copies.append(event_of(self._recording, data))
        except RecordingError as error:
            self._differs(str(error))

    def end(self) -> None:
        """Compare the copies of the last batch, and in a whole file the summary at its end."""
        recording = self._recording
        self._compare(last=True)
        if self.difference or not recording.whole:
            return
        end = read_end(recording.path)
        said = recording.compute_end_record().said
        if end is not None and end.said != said:
            self._differs(f'the end of the file says "{end.said}", and its events say "{said}"')

    def _compare(self, last: bool, follows: bool = True) -> None:
        """Compare the copies with the events of their batch, unless damage may have mixed them up.

        `last` is true for the last batch, whose copies may be missing if the file was cut off.
        `follows` is true if no step is missing before the next batch.
        """
        recording = self._recording
        if recording.damaged > self._damaged or not follows:
            return
        missing = last and bool(recording.cut or not recording.ended)
        for event, copy in zip_longest(self._events, self._copies):
            if event != copy:
                if copy is not None or not missing:
                    self._differs(
                        f"the file has two versions of an event: {_words(event)} in a step, but "
                        f"{_words(copy)} in the channel `events`"
                    )
                return

    def _differs(self, sentence: str) -> None:
        self.difference = self.difference or printable(sentence)


def _words(entry: TimelineEntry | None) -> str:
    if entry is None:
        return "nothing"
    by = f" (by {entry.by})" if entry.by else ""
    return f'"{entry.name}: {entry.text}{by}"'
