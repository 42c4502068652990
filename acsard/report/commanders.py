"""Who sent commands, whose counted, and why the others waited or were refused."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from acsard.config.settings import Source
from acsard.drive.words import REFUSED, waiting
from acsard.record.steps import Step
from acsard.report.thinning import Band
from acsard.robot import Robot
from acsard.values import NS_PER_S, Command, Outputs, Twist

DOES = ("refused", "waits", "sends", "drives")
"""What a source does while it is not silent; those first that stay where too many are to be drawn.
`sends`: its commands count, and the robot stands for another reason."""

MOVES = ("ready", "driving")
"""The modes in which a source decides whether the robot moves: in others it waits for no source."""

OTHERS = "others"
"""The sources that are in no list, whatever they call themselves."""

LOOK_S = 0.1
"""Between two looks at what the sources wait for, unless the mode or the commander changes."""

MOST_TEXT = 300
"""Characters of a sentence or a name that are kept."""

MOST_SENDERS = 256


class Commanders:
    """Follows all sources through the steps."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._timeouts = {
            source.name: source.timeout for source in sorted(sources, key=lambda s: -s.priority)
        }
        self.bands = {name: Band(DOES) for name in (*self._timeouts, OTHERS)}
        """The highest priority first."""
        self._newest: dict[tuple[str, str], Command] = {}
        """Of each sender of a source."""
        self._counted: Counter[str] = Counter()
        self._refused: dict[str, tuple[float, str]] = {}
        """Until when a source counts as refused, and why."""

    def name(self, source: str) -> str:
        """The source, if it is one of the list."""
        return source if source in self._timeouts else OTHERS

    def hear(self, step: Step, t: float, robot: Robot) -> bool:
        """Take the commands of a step; whether one was refused."""
        commands, before = step.inputs.commands, dict(self._refused)
        for command in commands:
            self._newest.pop((command.source, command.sender), None)
            self._newest[command.source, command.sender] = command
        while len(self._newest) > MOST_SENDERS:
            del self._newest[next(iter(self._newest))]
        for refusal in step.inputs.refusals:
            if refusal.source:
                self._refuse(refusal.source, t, refusal.text)
        if commands:
            self._objections(step, t, robot)
        return before != self._refused

    def _objections(self, step: Step, t: float, robot: Robot) -> None:
        """What the robot objected to in commands that could be read: counted by its reasons."""
        counted = Counter({name: robot.counters[f"command_{name}"] for name in REFUSED})
        news, self._counted = counted - self._counted, counted
        if not news:
            return
        words = "; ".join(REFUSED[reason] for reason in news)
        now_ns = step.inputs.now.mono_ns
        ages = {one.name: one.age_s for one in robot.snapshot(now_ns).sources}
        for command in step.inputs.commands:
            age_s = ages.get(command.source)
            if age_s is None or age_s * NS_PER_S > now_ns - command.arrived_ns + 1:
                self._refuse(command.source, t, words)  # else its newest one counts

    def _refuse(self, source: str, t: float, words: str) -> None:
        until = t + self._timeouts.get(source, LOOK_S)
        self._refused[self.name(source)] = until, words[:MOST_TEXT]

    def wish(self, outputs: Outputs) -> Twist | None:
        """What the command that is followed asks for."""
        if outputs.command_ns is None:
            return None
        for command in reversed(self._newest.values()):
            if command.arrived_ns == outputs.command_ns and command.source == outputs.source:
                return command.twist
        return None

    def look(self, step: Step, t: float, robot: Robot) -> None:
        """What each of them does now."""
        for name, does, words in self._do(step, t, robot):
            self.bands[name].add(t, does, words)

    def _do(self, step: Step, t: float, robot: Robot) -> Iterator[tuple[str, str, str]]:
        mode, reason, _, holder = step.said.status
        for one in robot.snapshot(step.inputs.now.mono_ns).sources:
            lately, wait = self._lately(one.name, t), one.waits_for
            if mode == "driving" and one.name == holder:
                yield one.name, "drives", waiting(wait)
            elif lately:
                yield one.name, "refused", lately
            elif wait.what == "command":
                yield one.name, "", ""
            elif mode not in MOVES or wait.what in ("nothing", "senders"):
                yield one.name, "sends", f"{mode}: {reason}"[:MOST_TEXT]
            else:
                yield one.name, "waits", waiting(wait)
        lately = self._lately(OTHERS, t)
        yield OTHERS, "refused" if lately else "", lately

    def _lately(self, name: str, t: float) -> str:
        """Why its commands were refused within its timeout, "" for not at all."""
        until, words = self._refused.get(name, (-math.inf, ""))
        return words if t < until else ""
