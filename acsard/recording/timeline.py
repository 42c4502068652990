"""Describes a recording as a timeline of short texts.

The timeline has an entry for each event of the log, and one for each drive. A drive is a time in
mode `driving`; its entry gives the distance and the duration.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Annotated

from msgspec import Meta, Struct
from msgspec.structs import replace

from acsard.core.formatting import many
from acsard.core.link.link_diagnosis import is_ours
from acsard.core.values import NS_PER_S, Event, Instant
from acsard.recording.recorded_steps import MICRO, Step

FURTHEST_S = 2**63 / 1e9
"""Largest distance of an entry's time from 1970, s: 292 years. No recording has other times."""


REASON_NS = NS_PER_S
"""Shortest time between two entries about a reason. Two sources may alternate in every step."""

NUMBER = re.compile(r"\b\d+(\.\d+)?\b")
"""A number, but not a digit of a name.

Reasons that differ only in numbers, such as a duration, count as one reason.
"""


class TimelineEntry(Struct, frozen=True, omit_defaults=True):
    """Entry of the timeline."""

    seconds: Annotated[float, Meta(ge=-FURTHEST_S, le=FURTHEST_S)]
    """Wall-clock time, s since 1970."""
    name: str
    """Name of the event, or a name that only the timeline uses.

    The names of the timeline are `link_late` for a `link_stale` that this computer caused,
    `link_heard` for a further event about a link that is already lost, `reason` for a change of the
    reason without a change of the mode, and `start`, `drive`, `gap` and `end`.
    """
    text: str
    level: str = "info"
    by: str = ""
    """The client that caused the event, or the source that commanded the drive."""
    count: int = 1
    """Number of equal events that this entry stands for."""


def entry_of(event: Event, wall_ns: int) -> TimelineEntry:
    """Return the entry of an event that happened at a wall-clock time, ns since 1970."""
    late = event.name == "link_stale" and is_ours(event.text)
    name = "link_late" if late else event.name
    return TimelineEntry(wall_ns / 1e9, name, event.text, event.level, event.by, event.count)


class LinkLosses:
    """Detects the further events about a link that is already lost."""

    def __init__(self) -> None:
        self._names: set[str] = set()
        """Names of the events about the lost link since the link was last up."""

    def repeated(self, name: str) -> bool:
        """Take an event, and return whether it repeats one about the same loss of the link."""
        if name == "link_up":
            self._names.clear()
        if name not in ("link_down", "link_booting", "link_stale", "link_late"):
            return False
        before = name in self._names
        self._names.add(name)
        return before


class ReasonChanges:
    """Detects that the robot does the same for another reason, which no event reports."""

    def __init__(self) -> None:
        self._mode = self._reason = ""
        """Mode and reason that the timeline has, the reason without its numbers."""
        self._reported_ns = -REASON_NS
        """Monotonic time of the last entry."""

    def step(self, step: Step) -> Iterator[TimelineEntry]:
        """Yield an entry if the reason changed and the mode did not. The events come before it."""
        mode, text, _, _ = step.recorded.status
        now, reason = step.inputs.now, NUMBER.sub("#", text)
        if reason == self._reason and mode == self._mode:
            return
        reported = mode != self._mode or any(event.text == text for event in step.recorded.events)
        if not reported and mode != "driving":
            if now.mono_ns - self._reported_ns < REASON_NS:
                return
            self._reported_ns = now.mono_ns
            yield TimelineEntry(now.wall_ns / 1e9, "reason", f"{mode}: {text}")
        self._mode, self._reason = mode, reason


class TimelineWriter:
    """Makes the timeline of a recording from its steps."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._pose: tuple[int, int, int] | None = None
        self._began_ns: int | None = None
        """Monotonic time at which the present drive began, ns; None between drives."""
        self._distance_m = 0.0
        """Distance of the present drive."""
        self._source = ""
        self._since = ""
        """Words for a drive that began before the first step; "" for any other drive."""
        self._now: Instant | None = None
        """Time of the last step."""
        self._shutting_down = False
        self._losses = LinkLosses()
        self._reasons = ReasonChanges()

    def step(self, step: Step) -> Iterator[TimelineEntry]:
        """Yield the entries of a step. The steps must come in order."""
        wall_s = step.inputs.now.wall_ns / 1e9
        if self._number is None and step.number == 0:
            yield TimelineEntry(wall_s, "start", "the daemon starts")
        elif self._number is not None and step.number != self._number + 1:
            missing = step.number - self._number - 1
            gap = f"{many(missing, 'step is', 'steps are')} missing before this one"
            yield TimelineEntry(wall_s, "gap", gap, "warning")
        yield from self._drive(step, wall_s)
        self._number, self._now = step.number, step.inputs.now
        for event in step.recorded.events:
            entry = entry_of(event, step.inputs.now.wall_ns)
            repeated = self._losses.repeated(entry.name)
            yield replace(entry, name="link_heard") if repeated else entry
        yield from self._reasons.step(step)
        if step.inputs.shutting_down and not self._shutting_down:
            yield TimelineEntry(wall_s, "end", "the daemon received the request to end")
        self._shutting_down = step.inputs.shutting_down

    def _drive(self, step: Step, wall_s: float) -> Iterator[TimelineEntry]:
        for pose in step.recorded.poses:
            if self._pose is not None and self._began_ns is not None:
                moved = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
                self._distance_m += moved / MICRO
            self._pose = pose
        mode, _, _, source = step.recorded.status
        now_ns = step.inputs.now.mono_ns
        if mode == "driving":
            if self._began_ns is None:
                self._began_ns, self._distance_m, self._source = now_ns, 0.0, source
                seen = self._number is not None or step.number == 0
                self._since = "" if seen else ", counted from the beginning of this recording"
        elif self._began_ns is not None:
            text = f"drove {self._driven(now_ns)}{self._since}"
            yield TimelineEntry(wall_s, "drive", text, by=self._source)
            self._began_ns = None

    def end(self) -> Iterator[TimelineEntry]:
        """Yield the entry of a drive that goes on at the last step, if there is one."""
        if self._began_ns is not None and self._now is not None:
            text = f"was driving, {self._driven(self._now.mono_ns)} so far{self._since}"
            yield TimelineEntry(self._now.wall_ns / 1e9, "drive", text, by=self._source)

    def _driven(self, now_ns: int) -> str:
        seconds = (now_ns - (self._began_ns or now_ns)) / 1e9
        return f"{self._distance_m:.2f} m in {seconds:.1f} s"


INCIDENTS = {
    "fault": "fault",
    "stop": "stop",
    "link_down": "lost port",
    "link_stale": "board silence",
    "link_late": "computer stall",
    "mcu_restarted": "board restart",
    "commander": "change of commander",
    "command_refused": "refused command",
    "wheel_fault": "wheel fault",
    "link_up": "",
}
"""Words for the events in a summary.

`link_up` has no words. It is in the table because it ends the loss of a link.
"""


def summary(events: Iterable[TimelineEntry], starts: bool = False) -> str:
    """Summarize the events of a recording in a few words.

    The summary counts each kind of incident and names the clients that stopped the robot. It begins
    with "start" if `starts` is true, because the recording begins with the daemon's start.
    """
    counts: Counter[str] = Counter()
    stopped: list[str] = []
    losses = LinkLosses()
    for event in events:
        word = INCIDENTS.get(event.name)
        if losses.repeated(event.name) or not word:
            continue
        if event.name == "stop" and event.by and event.by not in stopped:
            stopped.append(event.by)
        counts[word] += event.count
    parts = ["start"] if starts else []
    parts += [many(count, word) for word, count in counts.items()]
    text = ", ".join(parts)
    return f"{text} (stopped by {', '.join(stopped)})" if stopped else text
