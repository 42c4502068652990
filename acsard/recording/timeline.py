"""Describes a recording as a timeline of short texts.

The timeline has an entry for each event in the daemon's log, and further entries. For example, each
drive (a period in the mode `driving`) has an entry. `acsard recording show` and `acsard recording
report` show the same entries, and an export writes them to the channel `log`.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated

from msgspec import Meta, Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.formatting import lasting, many, printable_bytes
from acsard.core.link.link_diagnosis import blames_host
from acsard.core.link.session import IDENTITY
from acsard.core.motion.arbiter_text import MAX_SENDER_LENGTH
from acsard.core.ros.shapes import how_often
from acsard.core.values import NS_PER_S, Command, Event, Instant
from acsard.recording.recorded_steps import US_PER_S, RecordedStep

MAX_TIME_S = 2**63 / 1e9
"""Largest time between 1970 and an entry of the timeline, s. It is 292 years, because a time in ns
must fit in 64 bits."""


MIN_REASON_NS = NS_PER_S
"""Shortest time between two timeline entries with the same name, ns.

The limit applies to entries with the names `reason`, `waits` and `board`. Without this limit, two
sources that alternate in every step would fill the timeline.
"""

MAX_POSE_WAIT_NS = NS_PER_S
"""Longest time for which the timeline entry `continues` waits for the first pose, ns. The entry
contains this pose. Without a link to the board, poses do not arrive."""

MIN_CLOCK_CHANGE_NS = 5 * NS_PER_S
"""Smallest change of the wall clock that gives a timeline entry `clock`, ns. The change is measured
against the monotonic clock."""

MIN_WAIT_NS = NS_PER_S
"""If a sender sends speeds without effect for this time, ns, it gets a timeline entry `waits`.

While an operator changes from one sender to another, both senders may send, but for less than this
time.
"""

MIN_SILENCE_NS = NS_PER_S
"""Silence of a waiting sender, ns, after which the sender's waiting time restarts at 0."""

MAX_IDENTITY_BYTES = 256
"""Largest length, bytes, of the line with which a microcontroller names itself. The line of the
reference firmware has 150 bytes."""

MAX_WAITING = 16
"""Largest number of waiting senders that are tracked at a time. A waiting sender sends speeds while
the robot follows another sender. The number is limited, because a hostile client may use many
names."""

NUMBER = re.compile(r"\b\d+(\.\d+)?\b")
"""Pattern for a number in a reason, but not for a digit in a name. Reasons that differ only in
numbers count as equal."""


def clock_change_ns(before: Instant, after: Instant) -> int:
    """Return by how much the wall clock was set forward between two times, ns.

    The result is negative if the clock was set back.
    """
    return after.wall_ns - after.mono_ns - before.wall_ns + before.mono_ns


class TimelineEntry(Struct, frozen=True, omit_defaults=True):
    """An event of the daemon's log, or another entry of a recording's timeline."""

    seconds: Annotated[float, Meta(ge=-MAX_TIME_S, le=MAX_TIME_S)]
    """Wall-clock time, s since 1970."""
    name: str
    """Name of the event, or one of the names that only the timeline uses:

    - `start`: the daemon starts.
    - `continues`: the recording continues an earlier one.
    - `drive`: a drive has ended, or is under way as the recording ends.
    - `link_late`: an event `link_stale` that a delay of the daemon's computer caused.
    - `link_heard`: an event that repeats an earlier event about the same loss of the link.
    - `reason`: the reason of the robot's mode has changed, but the mode has not.
    - `waits`: a sender must wait while another one drives.
    - `board`: a microcontroller has named itself and its last reset.
    - `clock`: the wall clock was adjusted.
    - `gap`: steps are missing.
    - `end`: the daemon received the request to end.
    - `cut`: the recording has no ordinary end.
    """
    text: str
    level: str = "info"
    by: str = ""
    """The client that caused the event, or the sources that commanded the drive; "" if unknown."""
    count: int = 1
    """Number of equal events that the log combined into this entry."""

    @property
    def sentence(self) -> str:
        """The text, the client and the number of events, combined as in a line of the log."""
        by = f" (by {self.by})" if self.by else ""
        return f"{self.text}{by}{how_often(self.text, self.count)}"


def entry_of(event: Event, wall_ns: int) -> TimelineEntry:
    """Return the timeline entry for an event of the log.

    `wall_ns` is the wall-clock time of the event, ns since 1970.
    """
    late = event.name == "link_stale" and blames_host(event.text)
    name = "link_late" if late else event.name
    return TimelineEntry(wall_ns / 1e9, name, event.text, event.level, event.by, event.count)


class LinkLosses:
    """Detects repeated events about the same loss of the link to the board."""

    def __init__(self) -> None:
        self._names: set[str] = set()
        """Names of the events that have reported a lost link since the link was last up."""

    def repeated(self, name: str) -> bool:
        """Register the name of the next event.

        Return whether an earlier event with this name has reported the same loss of the link.
        """
        if name == "link_up":
            self._names.clear()
        if name not in ("link_down", "link_booting", "link_stale", "link_late"):
            return False
        before = name in self._names
        self._names.add(name)
        return before


class ReasonChanges:
    """Makes an entry `reason` when the reason of the robot's mode changes, but not the mode."""

    def __init__(self) -> None:
        self._mode = self._reason = ""
        """The last mode and reason that the timeline shows. A `#` replaces each number in the
        reason."""
        self._reported_ns = -MIN_REASON_NS
        """Monotonic time of the last entry `reason`, or of the last event that reports the mode
        `waiting` if this event is later, ns."""
        self._sender = ("", "")
        """Pair: the source that the robot followed last, and the sender of that source's last
        command."""

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry if the reason of the mode has changed in a step, but the mode has not.

        There is no entry if an event reports the reason, or while the robot drives. There is at
        most one entry each second.
        """
        mode, text, _, source = step.recorded.status
        now, reason = step.inputs.now, NUMBER.sub("#", text)
        for command in step.inputs.commands:
            if command.source == source:
                self._sender = (source, command.sender)
        if reason == self._reason and mode == self._mode:
            return
        reported = mode != self._mode or any(event.text == text for event in step.recorded.events)
        if reported and mode == "waiting":
            # If a link was lost for less than a second, the event about the loss is sufficient.
            self._reported_ns = now.mono_ns
        elif not reported and mode != "driving":
            if now.mono_ns - self._reported_ns < MIN_REASON_NS:
                return
            self._reported_ns = now.mono_ns
            by = _named(*self._sender) if source and source == self._sender[0] else source
            yield TimelineEntry(now.wall_ns / 1e9, "reason", f"{mode}: {text}", by=by)
        self._mode, self._reason = mode, reason


_IDENTITY = re.compile(re.escape(IDENTITY) + rb"([^\r\n]*)[\r\n]")


class BoardIdentity:
    """Makes an entry `board` when the board sends a line with its name.

    The board sends such a line after its start, and when the daemon asks for its name. The robot
    reports the line as an event only if the link was up. If the link was lost before the line
    arrived, only this entry shows that the board was restarted.
    """

    def __init__(self) -> None:
        self._data = b""
        """The last received bytes, if they may be the beginning of the line with the board's name;
        otherwise empty."""
        self._reported_ns = -MIN_REASON_NS
        """Monotonic time of the last entry `board`, ns."""

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry if the board has named itself in a step, but at most one each second."""
        now = step.inputs.now
        for read in step.inputs.received:
            data = self._data + read.data
            begin = data.find(IDENTITY[:1])
            if begin < 0:
                # Most reads contain no such line.
                self._data = b""
                continue
            self._data = data[begin:][-MAX_IDENTITY_BYTES:]
            match = _IDENTITY.search(self._data)
            if match is None:
                continue
            self._data = self._data[match.end() :]
            reported = any(event.name == "mcu_restarted" for event in step.recorded.events)
            if reported or now.mono_ns - self._reported_ns < MIN_REASON_NS:
                continue
            self._reported_ns = now.mono_ns
            words = printable_bytes(match[1], MAX_IDENTITY_BYTES)
            text = (
                "the microcontroller sent its name, as it does after a restart and after a "
                f"request: {words}"
            )
            yield TimelineEntry(now.wall_ns / 1e9, "board", text)


class _Waiting(Struct):
    """A sender that sends speeds while the robot follows another sender."""

    since_ns: int
    """Monotonic time of the sender's first speed that the robot did not follow, ns."""
    last_ns: int
    """Monotonic time of the sender's last speed that the robot did not follow, ns."""
    reported: bool = False
    """True if the sender already has an entry in the timeline."""


class WaitingSenders:
    """Makes an entry `waits` when a sender sends speeds, but the robot follows another sender."""

    def __init__(self, priorities: Mapping[str, int]) -> None:
        """Prepare for the first step. `priorities` maps each source's name to its priority."""
        self._priorities = priorities
        self._commander = ""
        """The sender that the robot follows, as the text "source (sender)" of the last event
        `commander`."""
        self._waiting: dict[tuple[str, str], _Waiting] = {}
        """Maps the pair (source, sender) to each waiting sender."""
        self._reported_ns = -MIN_REASON_NS
        """Monotonic time of the last entry `waits`, ns."""

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry for each sender that has waited for `MIN_WAIT_NS` and has no entry yet."""
        for event in step.recorded.events:
            if event.name == "commander":
                # If the log combined several changes of the sender, `by` contains several names.
                self._commander = event.by
        mode, _, _, source = step.recorded.status
        if mode != "driving":
            self._waiting.clear()
            return
        for command in step.inputs.commands:
            yield from self._command(command, source, step.inputs.now)

    def _command(self, command: Command, source: str, now: Instant) -> Iterator[TimelineEntry]:
        key, known = (command.source, command.sender), self._sender_is_known(source)
        shared = command.source == source
        speed = command.twist.linear or command.twist.angular
        why = self._why(command.source, source)
        if not (speed and why) or (shared and (not known or self._commander == _named(*key))):
            self._waiting.pop(key, None)
            return
        waiting = self._waiting.get(key)
        if waiting is None or now.mono_ns - waiting.last_ns > MIN_SILENCE_NS:
            if waiting is None and not self._has_room(now):
                return
            waiting = self._waiting[key] = _Waiting(now.mono_ns, now.mono_ns)
        waiting.last_ns = now.mono_ns
        since_ns = max(waiting.since_ns + MIN_WAIT_NS, self._reported_ns + MIN_REASON_NS)
        if waiting.reported or now.mono_ns < since_ns:
            return
        waiting.reported, self._reported_ns = True, now.mono_ns
        followed = self._commander if known else source
        text = f"this sender must wait: the robot follows the speeds of {followed}, {why}"
        yield TimelineEntry(now.wall_ns / 1e9, "waits", text, by=_named(*key))

    def _has_room(self, now: Instant) -> bool:
        if len(self._waiting) >= MAX_WAITING:
            oldest_ns = now.mono_ns - MIN_SILENCE_NS
            recent = {
                key: sender for key, sender in self._waiting.items() if sender.last_ns >= oldest_ns
            }
            self._waiting = recent
        return len(self._waiting) < MAX_WAITING

    def _sender_is_known(self, source: str) -> bool:
        """Return whether it is known which sender of the source `source` the robot follows.

        It is known if `_commander` contains a single sender, and this sender uses `source`.
        """
        return self._commander.startswith(f"{source} (") and ", " not in self._commander

    def _why(self, waiting: str, followed: str) -> str:
        """Return a text that says why the robot follows `followed` and not `waiting`.

        An example is "which came first". The arguments are names of sources. The text is "" if a
        priority is unknown, or if `waiting` has the higher priority. In the second case the source
        does not wait, because the robot refuses its commands for another reason.
        """
        priority, other = self._priorities.get(waiting), self._priorities.get(followed)
        if priority is None or other is None or priority > other:
            return ""
        return "which came first" if priority == other else "which has the higher priority"


def _named(source: str, sender: str) -> str:
    return f"{source} ({sender[:MAX_SENDER_LENGTH]})"


class TimelineWriter:
    """Makes the timeline of a recording from its steps."""

    def __init__(self, config: Config | None = None) -> None:
        """Prepare for the first step.

        `config` is the configuration of the recorded robot. If it is None, the timeline does not
        contain `waits` entries.
        """
        sources = config.commands.sources if config is not None else ()
        self._number: int | None = None
        self._pose: tuple[int, int, int] | None = None
        self._began_ns: int | None = None
        """Monotonic time at which the present drive began, ns; None between drives."""
        self._distance_m = 0.0
        self._sources: list[str] = []
        """The sources that commanded the present drive, in the order in which they began."""
        self._since = ""
        """Note at the end of the entry `drive` if the drive began before this recording; otherwise
        ""."""
        self._now: Instant | None = None
        self._shutting_down = False
        self._continued: RecordedStep | None = None
        """First step of a recording that continues an earlier recording. None in other recordings,
        and after the entry `continues` was made."""
        self._losses = LinkLosses()
        self._board = BoardIdentity()
        self._reasons = ReasonChanges()
        self._waiting = WaitingSenders({source.name: source.priority for source in sources})

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield the timeline entries of a step. The steps must come in order."""
        if self._number is None and step.number > 0:
            self._continued = step
        entries, first = list(self._entries(step)), self._continued
        if first is not None:
            waited_ns = step.inputs.now.mono_ns - first.inputs.now.mono_ns
            if entries or step.recorded.poses or waited_ns > MAX_POSE_WAIT_NS:
                yield from self._continues()
        yield from entries

    def _continues(self) -> Iterator[TimelineEntry]:
        first, self._continued = self._continued, None
        if first is None:
            return
        mode, reason, link, source = first.recorded.status
        does = mode if mode == "driving" else f"{mode} ({reason})"
        at = "the pose of the robot is not known"
        if self._pose is not None:
            x, y, yaw = [value / US_PER_S for value in self._pose]
            at = f"at x {x:.2f} m, y {y:.2f} m, yaw {math.degrees(yaw):.1f} deg"
        text = (
            "this recording continues an earlier one; at the start of this recording, the robot "
            f"is: {does}, link {link}, {at}"
        )
        yield TimelineEntry(first.inputs.now.wall_ns / 1e9, "continues", text, by=source)

    def _entries(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        wall_s = step.inputs.now.wall_ns / 1e9
        if self._number is None and step.number == 0:
            yield TimelineEntry(wall_s, "start", "the daemon starts")
        elif self._number is not None and self._now and step.number != self._number + 1:
            missing = step.number - self._number - 1
            seconds = (step.inputs.now.mono_ns - self._now.mono_ns) / 1e9
            gap = (
                f"{many(missing, 'step is', 'steps are')} missing before this step "
                f"({seconds:.1f} s)"
            )
            yield TimelineEntry(wall_s, "gap", gap, "warning")
        yield from self._clock(step.inputs.now)
        yield from self._drive(step, wall_s)
        self._number, self._now = step.number, step.inputs.now
        for event in step.recorded.events:
            entry = entry_of(event, step.inputs.now.wall_ns)
            repeated = self._losses.repeated(entry.name)
            yield replace(entry, name="link_heard") if repeated else entry
        yield from self._board.step(step)
        yield from self._reasons.step(step)
        yield from self._waiting.step(step)
        if step.inputs.shutting_down and not self._shutting_down:
            yield TimelineEntry(wall_s, "end", "the daemon received the request to end")
        self._shutting_down = step.inputs.shutting_down

    def _clock(self, now: Instant) -> Iterator[TimelineEntry]:
        ahead_ns = 0 if self._now is None else clock_change_ns(self._now, now)
        if abs(ahead_ns) < MIN_CLOCK_CHANGE_NS:
            return
        way = "forward" if ahead_ns > 0 else "back"
        # The monotonic clock does not advance while the computer is suspended.
        slept = ", or the computer was suspended" if ahead_ns > 0 else ""
        text = (
            f"the clock of the daemon's computer was set {way} by "
            f"{lasting(abs(ahead_ns) / NS_PER_S)}{slept}: the earlier entries show times of the "
            "clock before this change"
        )
        yield TimelineEntry(now.wall_ns / 1e9, "clock", text, "warning")

    def _drive(self, step: RecordedStep, wall_s: float) -> Iterator[TimelineEntry]:
        for pose in step.recorded.poses:
            if self._pose is not None and self._began_ns is not None:
                moved = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
                self._distance_m += moved / US_PER_S
            self._pose = pose
        if step.places:
            # The pose jumps before the next step, and a jump is no distance.
            self._pose = None
        mode, _, _, source = step.recorded.status
        now_ns = step.inputs.now.mono_ns
        if mode == "driving":
            if self._began_ns is None:
                self._began_ns, self._distance_m, self._sources = now_ns, 0.0, []
                is_complete = self._number is not None or step.number == 0
                self._since = (
                    "" if is_complete else ", counted from the beginning of this recording"
                )
            if source not in self._sources:
                self._sources.append(source)
        elif self._began_ns is not None:
            text = f"drove {self._driven(now_ns)}{self._since}"
            yield TimelineEntry(wall_s, "drive", text, by=", ".join(self._sources))
            self._began_ns = None

    def end(self, ending: str = "") -> Iterator[TimelineEntry]:
        """Yield the timeline entries that follow the last step.

        There is an entry `drive` if the robot still drives, and an entry `cut` if the recording was
        cut off. `ending` says how the recording was cut off, as in `Recording.ending`. It is "" if
        the daemon ended normally.
        """
        yield from self._continues()
        if self._now is None:
            return
        wall_s = self._now.wall_ns / 1e9
        if self._began_ns is not None:
            text = f"was driving, {self._driven(self._now.mono_ns)} so far{self._since}"
            yield TimelineEntry(wall_s, "drive", text, by=", ".join(self._sources))
        if ending:
            yield TimelineEntry(wall_s, "cut", ending.removeprefix("cut: "), "warning")

    def _driven(self, now_ns: int) -> str:
        seconds = (now_ns - (self._began_ns or now_ns)) / 1e9
        return f"{self._distance_m:.2f} m in {seconds:.1f} s"


INCIDENT_WORDS = {
    "fault": "fault",
    "stop": "stop",
    "emergency_stop": "emergency stop",
    "bumper_pressed": "bumper hit",
    "battery_stop": "battery stop",
    "link_down": "lost port",
    "link_stale": "board silence",
    "link_late": "computer stall",
    "mcu_restarted": "board restart",
    "commander": "change of commander",
    "command_refused": "refused command",
    "wheel_fault": "wheel fault",
    "link_up": "",
}
"""Word for an event in a summary, singular, by the name of the event. The event `link_up` has no
word: a summary does not count it, but it shows where a loss of the link ends."""


SERIOUS_SUMMARY = re.compile(r"(^|, )\d+ (emergency stop|bumper hit|battery stop|stop|fault)s?\b")
"""Pattern for the number of stops, bumper hits or faults in a summary. A stop may also be an
emergency stop or a battery stop. A wheel fault does not count as a fault."""


def is_serious(text: str) -> bool:
    """Return whether the text of a summary mentions a stop, a bumper hit or a fault.

    `text` is the result of `summary`. Emergency stops and battery stops are stops too. A wheel
    fault (`wheel_fault`) does not count.
    """
    # Ignore the names of the clients, because a name may look like a fault.
    return SERIOUS_SUMMARY.search(text.partition(" (stopped by ")[0]) is not None


def summary(events: Iterable[TimelineEntry], starts: bool = False) -> str:
    """Return a text that counts the incidents of a recording, such as "start, 2 stops".

    The text also names the clients that stopped the robot.

    Args:
        events: the events of the recording in order. Events that are not in `INCIDENT_WORDS` are
            ignored.
        starts: true if the recording includes the daemon's start.
    """
    counts: Counter[str] = Counter()
    stopped: list[str] = []
    losses = LinkLosses()
    for event in events:
        word = INCIDENT_WORDS.get(event.name)
        # A `wheel_fault` of level `info` reports the end of a fault: the wheel counts again.
        ended = event.name == "wheel_fault" and event.level == "info"
        if losses.repeated(event.name) or not word or ended:
            continue
        if event.name == "stop" and event.by and event.by not in stopped:
            stopped.append(event.by)
        counts[word] += event.count
    parts = ["start"] if starts else []
    parts += [many(count, word) for word, count in counts.items()]
    text = ", ".join(parts)
    return f"{text} (stopped by {', '.join(stopped)})" if stopped else text
