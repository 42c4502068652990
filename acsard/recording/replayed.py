"""Replays a recording file, and describes the result for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from acsard.core.config.live import flat
from acsard.core.config.parsing import ConfigError, effective, parse
from acsard.core.config.settings import Config
from acsard.core.config.validation import show
from acsard.core.formatting import listed, many, printable
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.values import Outputs
from acsard.host.errors import RecordingError
from acsard.recording.file import Recording
from acsard.recording.merge import adopt
from acsard.recording.recorded_steps import MICRO, Step, UnfinishedError, unfinished
from acsard.recording.replay import Comparison, Difference, Replay, Seen, fastest
from acsard.recording.rows import BatchError, decode
from acsard.recording.state import State, StateError, short, thaw

HUNDREDTHS = 100.0

Progress = Callable[[int], None]
"""Callback for progress; it takes the wall-clock time that the replay has reached, ns."""

EVERY = 1024
"""Number of steps between two calls of the progress callback."""


def quietly(wall_ns: int) -> None:
    """Ignore the progress."""


LACKS = (
    AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RecursionError
)  # fmt: skip
"""Exceptions that a robot raises if its recorded state lacks parts that this version expects."""


class Lived(NamedTuple):
    """Result of a replay."""

    tally: Comparison
    trouble: str
    """Why the replay ended before the end of the file; "" if it is complete."""
    again: str = ""
    """How this version handles the step in which the daemon failed; "" without a failure."""


def config_of(recording: Recording) -> Config:
    """Return the configuration of a recording.

    Raises `RecordingError` if this version cannot read it.
    """
    try:
        return parse(recording.about.config.encode())
    except ConfigError as error:
        raise RecordingError(
            f"this version cannot use the configuration in {recording.path}: {error}"
        ) from None


def steps(recording: Recording) -> Iterator[Step]:
    """Yield every step that can be read, in order. A gap shows in the steps' numbers."""
    for topic, _, data in recording.messages():
        if topic == "steps":
            try:
                batch = decode(data)
            except BatchError:
                recording.damaged += 1
                continue
            yield from batch


class Course:
    """The steps of a recording up to the first gap, and the robot that they begin with."""

    def __init__(self, recording: Recording, other: Config | None = None) -> None:
        """Use the recording's own configuration, or `other`.

        Raises `RecordingError` if that is impossible.
        """
        self.config = other or config_of(recording)
        """Configuration at the beginning."""
        self.trouble = ""
        """Why `steps` ended before the end of the file; "" if it did not."""
        self.number: int | None = None
        """Number of the last step that `steps` yielded."""
        self._recording = recording
        self._state, begins = _state(recording), Robot(self.config)
        self.robot, self.memory = self._state or (begins, Memory())
        if self._state is not None:
            # A state recorded by other code may lack parts that this version has, so adopt them
            # from a new robot.
            begun = Robot(config_of(recording))
            with self.living():
                adopt(self.robot, begun, begins)

    @contextmanager
    def living(self) -> Iterator[None]:
        """Turn errors of a recorded state that lacks needed parts into `RecordingError`.

        Wrap every use of `robot` in this context.
        """
        with _known(self._recording, self._state):
            yield

    def steps(self) -> Iterator[Step]:
        """Yield the steps until one is missing.

        Raises `RecordingError` if the first steps are missing, or no step can be read.
        """
        path = self._recording.path
        for step in steps(self._recording):
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
            raise RecordingError(f"{path} has no complete second of steps")


def live(recording: Recording, other: Config | None = None, progress: Progress = quietly) -> Lived:
    """Replay a recording with its own configuration, or `other`.

    Raises `RecordingError` if impossible.
    """
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
    """Run the step in which the daemon failed, and describe the result.

    This works only if the step follows the last recorded one.
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
    except Exception as error:  # noqa: BLE001 - whatever a fault of our own may be
        return f"{name} ends this version too, by {type(error).__name__}: {short(error)}"
    return f"{name} does not end the robot of this version"


class Onlooker:
    """Replay of a recording for display: everything that can be read, even if steps are missing."""

    def __init__(self, recording: Recording) -> None:
        """Read the recording; raise `RecordingError` if its configuration cannot be read."""
        self._recording = recording
        self.notes: list[str] = []
        """Notes for the user about how this replay may differ from the recorded drive."""
        self.config = config_of(recording)
        try:
            self._began = _state(recording)
            with self.living():
                if self._began is not None:
                    adopt(self._began.robot, Robot(self.config), Robot(self.config))
                self.replay = Replay(self.config, *(self._began or ()))
        except RecordingError as error:
            self._began, self.replay = None, Replay(self.config)
            self.notes.append(
                "the replay begins with a new robot, which knows nothing of the "
                f"time before: {error}"
            )

    @contextmanager
    def living(self) -> Iterator[None]:
        """Turn errors of a recorded state that lacks needed parts into `RecordingError`.

        Wrap every use of the robot in this context.
        """
        with _known(self._recording, self._began):
            yield

    def steps(self) -> Iterator[tuple[Step, Outputs, Robot]]:
        """Yield each recorded step, its replayed outputs, and the robot after it.

        Raises `RecordingError` if the recorded state lacks parts that a step needs.
        """
        number = None
        for step in steps(self._recording):
            if number is None and self._began is None and step.number > 0 and not self.notes:
                self.notes.append("its first steps are missing: the replay begins without them")
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
    """Turn errors of an incomplete robot into `RecordingError`.

    The robot may come from other code or a forged file, so any part of it may be missing or of a
    wrong type.
    """
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


def verdict(tally: Comparison) -> str:
    """Return the result of a replay in one line."""
    lines = f"{tally.lines_same:,} of {tally.lines:,} lines are the same".replace(",", " ")
    poses = f"{tally.poses_same:,} of {tally.poses:,} poses".replace(",", " ")
    modes = f"{tally.modes_same:,} of {tally.steps:,} modes".replace(",", " ")
    bits = (
        "" if not tally.same or tally.exact else " (poses agree to 1 um, but not to the last bit)"
    )
    return f"{lines}, {poses}, {modes}{bits}"


def compared(other: bool) -> str:
    """Explain the figures of `verdict`; `other` is true for another configuration."""
    by = "that configuration" if other else "this version"
    return (
        "(compared with the recording: every line to the board, every pose by odometry to the "
        f"um, and the mode in every step, as {by} computes them from the same inputs)"
    )


def differs(difference: Difference, began_ns: int) -> list[str]:
    """Return lines that show both sides of the first difference.

    `began_ns` is the monotonic time of the beginning.
    """
    seconds = (difference.at.mono_ns - began_ns) / 1e9
    what = ", ".join(difference.what)
    return [
        f"the first difference, in its {what}: step {difference.number}, {seconds:.3f} s after "
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
"""Prefixes of the settings that change which line a command produces."""

MOST_KEYS = 8


def because(then: Config, now: Config, tally: Comparison, began_ns: int) -> list[str]:
    """Explain in lines why another configuration leads to other results.

    The lines name the changed settings, the first line that differs by them, and a new fault. They
    also warn that the recorded wheels did not obey the new configuration.
    """
    before, after = (dict(flat(effective(config))) for config in (then, now))
    keys = [key for key in before | after if before.get(key) != after.get(key)]
    told = [f"{key} {_set(key, before)} then, {_set(key, after)} now" for key in keys]
    rows = [f"changed settings: {listed(told, MOST_KEYS, '; ') or 'nothing'}"]
    first, fault = tally.first, tally.fault
    if first is not None and "line" in first.what:
        shaping = [key for key in keys if key.startswith(SHAPE_LINES)]
        by = f": by {', '.join(shaping[:MOST_KEYS])}" if shaping else ""
        most, here = (fastest(one.line) / HUNDREDTHS for one in (first.then, first.now))
        rows.append(
            f"there the fastest wheel was commanded {most:.2f} rad/s, now {here:.2f} rad/s{by}"
        )
    if first is not None and fault is not None:
        seconds = (fault.at.mono_ns - began_ns) / 1e9
        rows.append(f"in fault from {seconds:.3f} s on: {printable(fault.now.status[1])}")
        if first.number < fault.number:
            rows.append(
                "  the recorded wheels turned as they were commanded then, not as they are "
                "commanded now: a robot with this configuration need not have had that fault. "
                "Only the part before it counts"
            )
    return rows


def _set(key: str, settings: Mapping[str, object]) -> str:
    return show(settings[key]) if key in settings else "not there"


def otherwise(tally: Comparison) -> list[str]:
    """Describe in lines how the robot would have behaved with other code or settings."""
    then_most, now_most = (speed / HUNDREDTHS for speed in tally.fastest)
    rows = [
        f"{tally.lines - tally.lines_same} of {tally.lines} lines would differ, and "
        f"{tally.steps - tally.modes_same} of {tally.steps} steps would have another mode",
        f"the fastest wheel: {then_most:.2f} rad/s then, {now_most:.2f} rad/s now",
    ]
    if tally.end is not None:
        (x, y, _), (here_x, here_y, _) = tally.end
        rows.append(
            f"the last pose by odometry: x {x / MICRO:.3f} y {y / MICRO:.3f} then, "
            f"x {here_x / MICRO:.3f} y {here_y / MICRO:.3f} now; at most {tally.apart:.3f} m apart"
        )
    return rows
