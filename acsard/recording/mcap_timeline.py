"""Describes a recording as a timeline of short texts.

It has an entry for each event of the log and more, such as each drive (a period in the mode
`driving`). `acsard recording show`, the report and the channel `log` of an export have the same
ones.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated

from msgspec import Meta, Struct
from msgspec.structs import replace

from acsard.core.codes import HOST_CODES
from acsard.core.config.settings import Config
from acsard.core.formatting import lasting, many, printable_bytes
from acsard.core.link.session import IDENTITY
from acsard.core.motion.arbiter_text import MAX_SENDER_LENGTH
from acsard.core.values import NS_PER_S, Command, Event, Instant, Ns, WallNs
from acsard.recording.recorded_steps import US_PER_S, RecordedStep

MAX_TIME_S = 2**63 / 1e9  # 292 years, because a time in ns must fit in 64 bits


# Between entries `reason`, `waits` or `board`: sources that alternate would fill the timeline.
MIN_REASON_NS = NS_PER_S

MAX_POSE_WAIT_NS = NS_PER_S  # of `continues` for its first pose, which without a link does not come

MIN_CLOCK_CHANGE_NS = 5 * NS_PER_S  # of the wall clock, for an entry `clock`

MIN_WAIT_NS = NS_PER_S  # two senders may send while an operator changes between them

MIN_SILENCE_NS = NS_PER_S  # of a waiting sender, after which its time restarts

MAX_IDENTITY_BYTES = 256  # of the line that names a board; the reference firmware's has 150

MAX_WAITING = 16  # tracked: a hostile client may use many names


def clock_change_ns(before: Instant, after: Instant) -> Ns:
    """Return by how much the wall clock was set forward between two times."""
    return after.wall_ns - after.mono_ns - before.wall_ns + before.mono_ns


class TimelineEntry(Struct, frozen=True, omit_defaults=True):
    """An event of the log, or another entry of a recording's timeline."""

    seconds: Annotated[float, Meta(ge=-MAX_TIME_S, le=MAX_TIME_S)]  # since 1970
    # Name of an event, or: start, continues (an earlier recording), drive (over, or under way at
    # the end), link_late (`link_stale` by a delay of this computer), link_heard (a repetition),
    # reason (of the same mode), waits (a sender while another one drives), board (named itself and
    # its last reset), clock (adjusted), gap (missing steps), end (requested), cut (no ordinary
    # end).
    name: str
    text: str
    level: str = "info"
    by: str = ""  # client of the event, or sources of the drive
    count: int = 1  # equal events in this entry

    @property
    def sentence(self) -> str:
        """The text and the client, as in a line of the log."""
        return f"{self.text} (by {self.by})" if self.by else self.text


def entry_of(event: Event, wall_ns: WallNs) -> TimelineEntry:
    late = event.name == "link_stale" and event.code in HOST_CODES
    name = "link_late" if late else event.name
    return TimelineEntry(wall_ns / 1e9, name, event.text, event.level, event.by, event.count)


class LinkLosses:
    """Detects repeated events about the same loss of the link to the board."""

    def __init__(self) -> None:
        self._names: set[str] = set()  # events of a lost link since it was up

    def repeated(self, name: str) -> bool:
        """Register an event; return whether one of this name has reported the same loss."""
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
        self._shown = ("", "", "")  # mode, code and source last shown
        self._reported_ns = -MIN_REASON_NS  # last entry `reason` or event of the mode `waiting`
        self._sender = ("", "")  # last followed source, and the sender of its last command

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry if only the reason has changed, at most one each second.

        There is none if an event reports it, or while the robot drives.
        """
        mode, text, _, source, code = step.recorded.status
        now, shown = step.inputs.now, (mode, code, source if mode == "ready" else "")
        for command in step.inputs.commands:
            if command.source == source:
                self._sender = (source, command.sender)
        if shown == self._shown:
            return
        codes = [event.code for event in step.recorded.events]
        reported = mode != self._shown[0] or code in codes
        if reported and mode == "waiting":
            # If a link was lost for less than a second, the event about the loss is sufficient.
            self._reported_ns = now.mono_ns
        elif not reported and mode != "driving":
            if now.mono_ns - self._reported_ns < MIN_REASON_NS:
                return
            self._reported_ns = now.mono_ns
            by = _named(*self._sender) if source and source == self._sender[0] else source
            yield TimelineEntry(now.wall_ns / 1e9, "reason", f"{mode}: {text}", by=by)
        self._shown = shown


_IDENTITY = re.compile(re.escape(IDENTITY) + rb"([^\r\n]*)[\r\n]")


class BoardIdentity:
    """Makes an entry `board` when the board sends a line with its name.

    It does so after its start and on request. The robot reports it only if the link was up, so
    without this entry a restart may be unknown.
    """

    def __init__(self) -> None:
        self._data = b""  # maybe the beginning of that line
        self._reported_ns = -MIN_REASON_NS  # last entry

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry if the board has named itself, at most one each second."""
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
    # Sends speeds while the robot follows another sender.
    since_ns: Ns  # first speed that the robot did not follow
    last_ns: Ns  # last one
    reported: bool = False  # in the timeline


class WaitingSenders:
    """Makes an entry `waits` when a sender sends speeds, but the robot follows another sender."""

    def __init__(self, priorities: Mapping[str, int]) -> None:
        self._priorities = priorities  # of the sources
        self._commander = ""  # "source (sender)" of the last event; several if it joins changes
        self._known = ""  # source of this commander, if a single one, which has sent since
        self._waiting: dict[tuple[str, str], _Waiting] = {}  # by source and sender
        self._reported_ns = -MIN_REASON_NS  # last entry

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield an entry for each sender that has waited for `MIN_WAIT_NS` and has none."""
        for event in step.recorded.events:
            if event.name == "commander":
                self._commander, self._known = event.by, ""
        mode, _, _, source, _ = step.recorded.status
        if mode != "driving":
            self._waiting.clear()
            return
        for command in step.inputs.commands:
            if _named(command.source, command.sender) == self._commander:
                self._known = command.source
        for command in step.inputs.commands:
            yield from self._command(command, source, step.inputs.now)

    def _command(self, command: Command, source: str, now: Instant) -> Iterator[TimelineEntry]:
        key, known = (command.source, command.sender), self._known == source
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

    def _why(self, waiting: str, followed: str) -> str:
        # Such as "which came first". A source of the higher priority does not wait: its commands
        # are refused for another reason.
        priority, other = self._priorities.get(waiting), self._priorities.get(followed)
        if priority is None or other is None or priority > other:
            return ""
        return "which came first" if priority == other else "which has the higher priority"


def _named(source: str, sender: str) -> str:
    return f"{source} ({sender[:MAX_SENDER_LENGTH]})"


class TimelineWriter:
    """Makes the timeline of a recording from its steps."""

    def __init__(self, config: Config | None = None) -> None:
        # Without `config`, there are no entries `waits`.
        sources = config.commands.sources if config is not None else ()
        self._number: int | None = None
        self._pose: tuple[int, int, int] | None = None
        self._began_ns: Ns | None = None  # begin of the present drive
        self._distance_m = 0.0
        self._sources: list[str] = []  # of the present drive, in their order
        self._since = ""  # note of a drive that began before this recording
        self._now: Instant | None = None
        self._shutting_down = False
        self._continued: RecordedStep | None = None  # first step of one that continues another
        self._losses = LinkLosses()
        self._board = BoardIdentity()
        self._reasons = ReasonChanges()
        self._waiting = WaitingSenders({source.name: source.priority for source in sources})

    def step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        """Yield the entries of a step. The steps must come in order."""
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
        mode, reason, link, source, _ = first.recorded.status
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
        mode, _, _, source, _ = step.recorded.status
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
        """Yield the entries after the last step: an unfinished `drive`, and `cut`."""
        yield from self._continues()
        if self._now is None:
            return
        wall_s = self._now.wall_ns / 1e9
        if self._began_ns is not None:
            text = f"was driving, {self._driven(self._now.mono_ns)} so far{self._since}"
            yield TimelineEntry(wall_s, "drive", text, by=", ".join(self._sources))
        if ending:
            yield TimelineEntry(wall_s, "cut", ending, "warning")

    def _driven(self, now_ns: Ns) -> str:
        seconds = (now_ns - (self._began_ns or now_ns)) / 1e9
        return f"{self._distance_m:.2f} m in {seconds:.1f} s"


# Singular; `link_up` only shows where a loss ends.
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


SERIOUS = frozenset({"fault", "stop", "emergency_stop", "bumper_pressed", "battery_stop"})


def is_serious(events: Iterable[TimelineEntry]) -> bool:
    """Return whether the events have a stop, a bumper hit or a fault (not of a wheel)."""
    return any(event.name in SERIOUS for event in events)


def summary(events: Iterable[TimelineEntry], starts: bool = False) -> str:
    """Return the incidents of a recording, such as "start, 2 stops", with who stopped it.

    `starts` says that it includes the daemon's start.
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
