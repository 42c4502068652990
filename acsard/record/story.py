"""Steps -> sentences: what a person asks a recording for.

Every event of the log is one, and so is each drive: from the first line that moves a wheel in mode
driving to the end of it, with its way and its time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator

from msgspec import Struct

from acsard.record.steps import MICRO, Step
from acsard.values import Event


class Told(Struct, frozen=True, omit_defaults=True):
    """A sentence; `seconds` are wall-clock time since 1970."""

    seconds: float
    name: str
    """The event's, or `start`, `drive`, `gap` and `end`."""
    text: str
    level: str = "info"
    by: str = ""
    count: int = 1


def told(event: Event, wall_ns: int) -> Told:
    """The sentence of an event at that time."""
    return Told(wall_ns / 1e9, event.name, event.text, event.level, event.by, event.count)


class Story:
    """Takes one step after the other."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._pose: tuple[int, int, int] | None = None
        self._began_ns: int | None = None
        """When the drive began that is under way, monotonic."""
        self._way = 0.0
        self._source = ""
        self._leaving = False

    def step(self, step: Step) -> Iterator[Told]:
        """What there is to say of it."""
        wall_s = step.inputs.now.wall_ns / 1e9
        if self._number is None and step.number == 0:
            yield Told(wall_s, "start", "the daemon starts")
        elif self._number is not None and step.number != self._number + 1:
            missing = step.number - self._number - 1
            yield Told(wall_s, "gap", f"{missing} steps are missing before this one", "warning")
        self._number = step.number
        yield from self._drive(step, wall_s)
        for event in step.said.events:
            yield told(event, step.inputs.now.wall_ns)
        if step.inputs.leaving and not self._leaving:
            yield Told(wall_s, "end", "the daemon is told to end")
        self._leaving = step.inputs.leaving

    def _drive(self, step: Step, wall_s: float) -> Iterator[Told]:
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
            yield Told(wall_s, "drive", text, by=self._source)
            self._began_ns = None


NEWS = {
    "fault": "fault",
    "stop": "stop",
    "link_down": "port lost",
    "link_stale": "board silent",
    "mcu_restarted": "board restarted",
    "commander": "takeover",
    "command_refused": "refused command",
    "wheels_doubted": "doubted wheel",
}
"""What a list says of a recording, and how."""


def summary(events: Iterable[Told]) -> str:
    """What happened, in a few words: who stopped it, and how often the rest was."""
    counts: Counter[str] = Counter()
    stopped: list[str] = []
    for event in events:
        word = NEWS.get(event.name)
        if word is None:
            continue
        if event.name == "stop" and event.by and event.by not in stopped:
            stopped.append(event.by)
        counts[word] += event.count
    said = [f"{count} {word}{'s' * (count > 1)}" for word, count in counts.items()]
    text = ", ".join(said)
    return f"{text} (stopped by {', '.join(stopped)})" if stopped else text
