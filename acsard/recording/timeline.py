"""Describes a recording as a timeline of sentences.

Each event of the log is a sentence, and so is each drive: the time in mode `driving`, with its
distance and its duration.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Annotated

from msgspec import Meta, Struct
from msgspec.structs import replace

from acsard.core.formatting import many
from acsard.core.link.link_diagnosis import is_ours
from acsard.core.values import Event
from acsard.recording.recorded_steps import MICRO, Step

FURTHEST_S = 2**63 / 1e9
"""Bound of a sentence's time, s from 1970: 292 years. No recording has a time beyond it."""


class TimelineEntry(Struct, frozen=True, omit_defaults=True):
    """Sentence of the timeline; `seconds` is wall-clock time since 1970."""

    seconds: Annotated[float, Meta(ge=-FURTHEST_S, le=FURTHEST_S)]
    name: str
    """Name of the event, or a name that only the timeline uses.

    These are `link_late` for a `link_stale` that this computer caused, `link_heard` for a further
    event about a link that is already lost, and `start`, `drive`, `gap` and `end`.
    """
    text: str
    level: str = "info"
    by: str = ""
    count: int = 1


def told(event: Event, wall_ns: int) -> TimelineEntry:
    """Return the sentence of an event at a wall-clock time in ns."""
    late = event.name == "link_stale" and is_ours(event.text)
    name = "link_late" if late else event.name
    return TimelineEntry(wall_ns / 1e9, name, event.text, event.level, event.by, event.count)


class Losses:
    """Memory of the link's loss, to tell the first event about a loss from further ones."""

    def __init__(self) -> None:
        self._told: set[str] = set()
        """Names of the events since the link was last up."""

    def again(self, name: str) -> bool:
        """Return whether an event of this name has come since the link was last up."""
        if name == "link_up":
            self._told.clear()
        if name not in ("link_down", "link_booting", "link_stale", "link_late"):
            return False
        before = name in self._told
        self._told.add(name)
        return before


class TimelineWriter:
    """Timeline of a recording. It takes the steps in order."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._pose: tuple[int, int, int] | None = None
        self._began_ns: int | None = None
        """Monotonic time at which the present drive began, ns; None between drives."""
        self._way = 0.0
        self._source = ""
        self._leaving = False
        self._losses = Losses()

    def step(self, step: Step) -> Iterator[TimelineEntry]:
        """Yield the sentences of a step."""
        wall_s = step.inputs.now.wall_ns / 1e9
        if self._number is None and step.number == 0:
            yield TimelineEntry(wall_s, "start", "the daemon starts")
        elif self._number is not None and step.number != self._number + 1:
            missing = step.number - self._number - 1
            gap = f"{many(missing, 'step is', 'steps are')} missing before this one"
            yield TimelineEntry(wall_s, "gap", gap, "warning")
        self._number = step.number
        yield from self._drive(step, wall_s)
        for event in step.said.events:
            one = told(event, step.inputs.now.wall_ns)
            yield replace(one, name="link_heard") if self._losses.again(one.name) else one
        if step.inputs.leaving and not self._leaving:
            yield TimelineEntry(wall_s, "end", "the daemon received the request to end")
        self._leaving = step.inputs.leaving

    def _drive(self, step: Step, wall_s: float) -> Iterator[TimelineEntry]:
        for pose in step.said.poses:
            if self._pose is not None and self._began_ns is not None:
                self._way += math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1]) / MICRO
            self._pose = pose
        mode, _, _, source = step.said.status
        now_ns = step.inputs.now.mono_ns
        if mode == "driving":
            if self._began_ns is None:
                self._began_ns, self._way, self._source = now_ns, 0.0, source
        elif self._began_ns is not None:
            seconds = (now_ns - self._began_ns) / 1e9
            text = f"drove {self._way:.2f} m in {seconds:.1f} s"
            yield TimelineEntry(wall_s, "drive", text, by=self._source)
            self._began_ns = None


NEWS = {
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
"""Words for the events in a summary; "" for an event that only ends another one."""


def summary(events: Iterable[TimelineEntry], starts: bool = False) -> str:
    """Summarize the events in a few words.

    The summary says whether the daemon starts, counts each kind of incident, and names the clients
    that stopped the robot.
    """
    counts: Counter[str] = Counter()
    stopped: list[str] = []
    losses = Losses()
    for event in events:
        word = NEWS.get(event.name)
        if losses.again(event.name) or not word:
            continue
        if event.name == "stop" and event.by and event.by not in stopped:
            stopped.append(event.by)
        counts[word] += event.count
    said = ["start"] if starts else []
    said += [many(count, word) for word, count in counts.items()]
    text = ", ".join(said)
    return f"{text} (stopped by {', '.join(stopped)})" if stopped else text
