"""A recording lived again: file -> replay -> what to say of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from acsard.config.live import flat
from acsard.config.parsing import ConfigError, effective, parse
from acsard.config.settings import Config
from acsard.config.validation import show
from acsard.guard import Memory
from acsard.host.errors import RecordingError
from acsard.messages.text import printable
from acsard.record.batch import BatchError, decode
from acsard.record.file import Recording
from acsard.record.merge import adopt
from acsard.record.replay import Difference, Replay, Seen, Tally, fastest
from acsard.record.state import State, StateError, short, thaw
from acsard.record.steps import MICRO, Step, UnfinishedError, unfinished
from acsard.robot import Robot
from acsard.values import Outputs

HUNDREDTHS = 100.0

Progress = Callable[[int], None]
"""Called now and then with the wall-clock time that it has come to, ns."""

EVERY = 1024
"""Steps from one call of it to the next."""


def quietly(wall_ns: int) -> None:
    """Progress that nobody looks at."""


LACKS = (
    AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RecursionError
)  # fmt: skip
"""What a robot raises that has not the parts it ought to have."""


class Lived(NamedTuple):
    """What came of it."""

    tally: Tally
    trouble: str
    """Why it was not lived to the end of the file, "" when it was."""
    again: str = ""
    """What becomes of the step that a fault of the daemon's own ended, "" where none did."""


def config_of(recording: Recording) -> Config:
    """The configuration it was made with; raises `RecordingError`."""
    try:
        return parse(recording.about.config.encode())
    except ConfigError as error:
        raise RecordingError(
            f"the configuration in {recording.path} is none for this version: {error}"
        ) from None


def steps(recording: Recording) -> Iterator[Step]:
    """Every step that can be read, in order; where some are missing their numbers say so."""
    reason = ""
    for topic, _, data in recording.messages():
        if topic == "steps":
            try:
                batch = decode(data, reason, recording.about.format)
            except BatchError:
                recording.damaged += 1
                continue
            yield from batch
            reason = batch[-1].said.status[1] if batch else reason


class Course:
    """The steps of a recording from its beginning on, and the robot they begin with."""

    def __init__(self, recording: Recording, other: Config | None = None) -> None:
        """With its own configuration, or with another; raises `RecordingError`."""
        self.config = other or config_of(recording)
        """What it begins with."""
        self.trouble = ""
        """Why it was not gone to the end of the file, "" when it was."""
        self.number: int | None = None
        """Of the step that was gone last."""
        self._recording = recording
        self._state, begins = _state(recording), Robot(self.config)
        self.robot, self.memory = self._state or (begins, Memory())
        if self._state is not None:
            # by newer code, its parts may have what it knows nothing of
            begun = Robot(config_of(recording))
            with self.living():
                adopt(self.robot, begun, begins)

    @contextmanager
    def living(self) -> Iterator[None]:
        """Around what lives it; raises `RecordingError` where its state lacks what is asked."""
        with _known(self._recording, self._state):
            yield

    def steps(self) -> Iterator[Step]:
        """One after the other, while none is missing; raises `RecordingError`."""
        path = self._recording.path
        for step in steps(self._recording):
            number = self.number
            if number is None and self._state is None and step.number > 0:
                raise RecordingError(f"{path}: its first steps are missing or damaged")
            if number is not None and step.number != number + 1:
                missing = step.number - number - 1
                self.trouble = f"{missing} steps are missing after step {number}"
                return
            self.number = step.number
            yield step
        if self.number is None:
            raise RecordingError(f"{path} has no whole second of steps")


def live(recording: Recording, other: Config | None = None, progress: Progress = quietly) -> Lived:
    """Replay it with its own configuration, or with another; raises `RecordingError`."""
    course = Course(recording, other)
    with course.living():
        replay = Replay(course.config, course.robot, course.memory)
        for number, step in enumerate(course.steps()):
            if number % EVERY == 0:
                progress(step.inputs.now.wall_ns)
            replay.step(step)
    again = "" if course.trouble else _again(recording, replay.robot, course.number)
    return Lived(replay.tally, course.trouble, again)


def _again(recording: Recording, robot: Robot, last: int | None) -> str:
    """What becomes now of the step that ended the daemon, if it comes after the last one."""
    if recording.unfinished is None:
        return ""
    try:
        step = unfinished(recording.unfinished)
    except UnfinishedError as error:
        return str(error)
    name = f"step {step.number}, which ended the daemon,"
    if last is None or step.number != last + 1:
        return f"{name} does not follow on the last one"
    try:
        robot.step(step.inputs)
    except Exception as error:  # noqa: BLE001 - whatever a fault of our own may be
        return f"{name} ends this version too, by {type(error).__name__}: {short(error)}"
    return f"{name} does not end the robot of this version"


class Onlooker:
    """Lives a recording for who looks on: all that can be read of it, whatever is missing."""

    def __init__(self, recording: Recording) -> None:
        """Raises `RecordingError`."""
        self._recording = recording
        self.notes: list[str] = []
        """What is not as it was then, in words."""
        self.config = config_of(recording)
        try:
            self._began = _state(recording)
            with self.living():
                if self._began is not None:
                    adopt(self._began.robot, Robot(self.config), Robot(self.config))
                self.replay = Replay(self.config, *(self._began or ()))
        except RecordingError as error:
            self._began, self.replay = None, Replay(self.config)
            self.notes.append(f"what is computed begins with a robot that knows nothing: {error}")

    @contextmanager
    def living(self) -> Iterator[None]:
        """Around what asks the robot; raises `RecordingError` where its state lacks the answer."""
        with _known(self._recording, self._began):
            yield

    def steps(self) -> Iterator[tuple[Step, Outputs, Robot]]:
        """Each step as it was recorded, what it decides now, and the robot after it.

        Raises `RecordingError` where its state lacks what is asked of it.
        """
        number = None
        for step in steps(self._recording):
            if number is None and self._began is None and step.number > 0 and not self.notes:
                self.notes.append("its first steps are missing: the robot is begun without them")
            number = step.number
            with self.living():
                self.replay.step(step)
            if self.replay.outputs is not None:
                yield step, self.replay.outputs, self.replay.robot


def _state(recording: Recording) -> State | None:
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
def _known(recording: Recording, state: State | None) -> Iterator[None]:
    """A robot of other code, or that a stranger has made, may lack what is asked of it, or have
    something else in its place, however deep in it."""
    try:
        yield
    except RecordingError:
        raise
    except LACKS as error:
        if state is None:
            raise
        lacks = f"this version cannot read the state at its start: {short(error)}"
        raise _foreign(recording, lacks) from error


def _foreign(recording: Recording, why: str) -> RecordingError:
    return RecordingError(
        f"{recording.path}: {why}; it was recorded by acsard {recording.about.version}, whose "
        "replay can read it"
    )


def verdict(tally: Tally) -> str:
    """The answer in one line."""
    lines = f"{tally.lines_same:,} of {tally.lines:,} lines the same".replace(",", " ")
    poses = f"{tally.poses_same:,} of {tally.poses:,} poses".replace(",", " ")
    modes = f"{tally.modes_same:,} of {tally.steps:,} modes".replace(",", " ")
    bits = "" if not tally.same or tally.exact else " (poses to the um, not to the last bit)"
    return f"{lines}, {poses}, {modes}{bits}"


def compared(other: bool) -> str:
    """What the verdict has counted."""
    by = "that configuration" if other else "this version"
    return (
        "(compared: every line to the board, every pose by odometry to the um, and the mode in "
        f"every step, as recorded, with what {by} makes of the same inputs)"
    )


def differs(difference: Difference, began_ns: int) -> list[str]:
    """What each side knew where they first part, in lines."""
    seconds = (difference.at.mono_ns - began_ns) / 1e9
    what = ", ".join(difference.what)
    return [
        f"the first that differs, by its {what}: step {difference.number}, {seconds:.3f} s after "
        "the beginning",
        *_side("then", difference.then),
        *_side("now", difference.now),
    ]


def _side(name: str, seen: Seen) -> list[str]:
    mode, reason, link, source = map(printable, seen.status)
    line = "no line" if seen.line is None else printable(seen.line.decode(errors="replace").strip())
    poses = [[f"{value / MICRO:.6f}" for value in pose] for pose in seen.poses]
    rows = [
        f"  {name:4}  {line}",
        f"        mode {mode} ({reason}), link {link}, source {source or 'none'}",
        *[f"        pose x {x} y {y} yaw {yaw}" for x, y, yaw in poses],
    ]
    return [*rows, f"        the guard: {seen.trip}"] if seen.trip else rows


SHAPE_LINES = ("limits.", "drive.", "mcu.wheels.")
"""The tables that make of the same command another line."""

MOST_KEYS = 8


def because(then: Config, now: Config, tally: Tally, began_ns: int) -> list[str]:
    """What the other configuration changes, in words: which settings, what was sent by them, and
    that the wheels of the recording did not obey it."""
    before, after = (dict(flat(effective(config))) for config in (then, now))
    keys = [key for key in before | after if before.get(key) != after.get(key)]
    told = [f"{key} {_set(key, before)} then, {_set(key, after)} now" for key in keys]
    more = [f"and {len(told) - MOST_KEYS} more"] if len(told) > MOST_KEYS else []
    rows = [f"set otherwise: {'; '.join(told[:MOST_KEYS] + more) or 'nothing'}"]
    first, fault = tally.first, tally.fault
    if first is not None and "line" in first.what:
        shaping = [key for key in keys if key.startswith(SHAPE_LINES)]
        by = f": by {', '.join(shaping[:MOST_KEYS])}" if shaping else ""
        most, here = (fastest(one.line) / HUNDREDTHS for one in (first.then, first.now))
        rows.append(f"there the fastest wheel was told {most:.2f} rad/s, now {here:.2f} rad/s{by}")
    if first is not None and fault is not None:
        seconds = (fault.at.mono_ns - began_ns) / 1e9
        rows.append(f"from {seconds:.3f} s on in fault: {printable(fault.now.status[1])}")
        if first.number < fault.number:
            rows.append(
                "  the wheels of the recording turned as they were told then, not as they are told "
                "now: a robot with this configuration need not have had that fault. What is before "
                "it counts"
            )
    return rows


def _set(key: str, settings: Mapping[str, object]) -> str:
    return show(settings[key]) if key in settings else "not there"


def otherwise(tally: Tally) -> list[str]:
    """What another configuration, or other code, would have done, in words and figures."""
    then_most, now_most = (speed / HUNDREDTHS for speed in tally.fastest)
    rows = [
        f"{tally.lines - tally.lines_same} of {tally.lines} lines would be others, "
        f"{tally.steps - tally.modes_same} of {tally.steps} steps in another mode",
        f"the fastest wheel: {then_most:.2f} rad/s then, {now_most:.2f} rad/s now",
    ]
    if tally.end is not None:
        (x, y, _), (here_x, here_y, _) = tally.end
        rows.append(
            f"the end by odometry: x {x / MICRO:.3f} y {y / MICRO:.3f} then, "
            f"x {here_x / MICRO:.3f} y {here_y / MICRO:.3f} now; at most {tally.apart:.3f} m apart"
        )
    return rows
