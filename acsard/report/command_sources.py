"""The command sources over time: which one drove, and why the others waited or were refused."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from acsard.core.config.settings import Source
from acsard.core.motion.arbiter_text import REFUSED, waiting
from acsard.core.robot import Robot
from acsard.core.thinning import Band
from acsard.core.values import NS_PER_S, Command, Outputs, Twist
from acsard.recording.recorded_steps import Step

DOES = ("refused", "waits", "sends", "drives")
"""States of a source that is not silent, in the order in which they win when short spans are
merged.

`sends` means that its commands are accepted but the robot stands for another reason.
"""

MOVES = ("ready", "driving")
"""Modes in which a source decides whether the robot moves. In the other modes the robot follows
none."""

OTHERS = "others"
"""Collective name of sources that are not in the configuration."""

LOOK_S = 0.1
"""Interval in s at which the sources are sampled, unless the mode or the driving source changes."""

MOST_TEXT = 300
"""Maximum number of characters that are kept of a sentence or a name."""

MOST_SENDERS = 256


class CommandSources:
    """The states of all sources over the steps."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._timeouts = {
            source.name: source.timeout for source in sorted(sources, key=lambda s: -s.priority)
        }
        self.bands = {name: Band(DOES) for name in (*self._timeouts, OTHERS)}
        """The states of each source, highest priority first."""
        self._newest: dict[tuple[str, str], Command] = {}
        """Last command by (source, sender), the newest last."""
        self._counted: Counter[str] = Counter()
        self._refused: dict[str, tuple[float, str]] = {}
        """Time until which a source counts as refused, and the reason."""

    def name(self, source: str) -> str:
        """Return the name of a configured source, or `OTHERS`."""
        return source if source in self._timeouts else OTHERS

    def hear(self, step: Step, t: float, robot: Robot) -> bool:
        """Take the commands of a step; return whether the set of refused sources changed."""
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
        """Find the commands of this step that the robot refused, by its counters.

        A counter does not name the source, so the command of each source is compared with the last
        accepted one.
        """
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
                self._refuse(command.source, t, words)  # otherwise the robot accepted it

    def _refuse(self, source: str, t: float, words: str) -> None:
        until = t + self._timeouts.get(source, LOOK_S)
        self._refused[self.name(source)] = until, words[:MOST_TEXT]

    def wish(self, outputs: Outputs) -> Twist | None:
        """Return the twist of the command that the robot follows, or None."""
        if outputs.command_ns is None:
            return None
        for command in reversed(self._newest.values()):
            if command.arrived_ns == outputs.command_ns and command.source == outputs.source:
                return command.twist
        return None

    def look(self, step: Step, t: float, robot: Robot) -> None:
        """Record the present state of each source."""
        for name, does, words in self._do(step, t, robot):
            self.bands[name].add(t, does, words)

    def _do(self, step: Step, t: float, robot: Robot) -> Iterator[tuple[str, str, str]]:
        mode, reason, _, holder = step.recorded.status
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
        """Return why commands of a source were refused within its timeout, or ""."""
        until, words = self._refused.get(name, (-math.inf, ""))
        return words if t < until else ""
