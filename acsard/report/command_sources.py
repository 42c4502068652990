"""Determines the state of each command source over time, with a reason in words.

It drove the robot, waited, sent commands without effect, was refused, or was silent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from acsard.core.config.settings import Source
from acsard.core.motion.arbiter_text import OBJECTIONS, waiting
from acsard.core.robot import Robot
from acsard.core.thinning import Band
from acsard.core.values import NS_PER_S, Command, Outputs, Twist
from acsard.recording.recorded_steps import RecordedStep
from acsard.report.robot_reader import RobotReader

# Most important first, which wins a merge. `sends`: accepted, but the source does not drive.
SOURCE_STATES = ("refused", "waits", "sends", "drives")

FOLLOWING_MODES = ("ready", "driving")  # in others, the robot follows no source

OTHER_SOURCES = "others"  # all sources that are not in the configuration

# A change of mode, reason, link or driving source causes an additional sample.
SAMPLE_PERIOD_S = 0.1

MAX_TEXT_LENGTH = 300  # characters

MAX_SENDERS = 256  # whose last command is kept


class CommandSources:
    """The states of all command sources over time."""

    def __init__(self, sources: Sequence[Source], reader: RobotReader) -> None:
        self._reader = reader
        self._timeouts = {
            source.name: source.timeout for source in sorted(sources, key=lambda s: -s.priority)
        }
        # Bands by source, the highest priority first.
        self.bands = {name: Band(SOURCE_STATES) for name in (*self._timeouts, OTHER_SOURCES)}
        self._newest: dict[tuple[str, str], Command] = {}  # by source and sender, the newest last
        self._robot: Robot | None = None  # of the last step
        self._counted: Counter[str] = Counter()  # refusals so far, by reason
        # Refusals by source: end in s of the report, reason, code.
        self._refused: dict[str, tuple[float, str, str]] = {}

    def name(self, source: str) -> str:
        """Return the name of a source, or `OTHER_SOURCES`."""
        return source if source in self._timeouts else OTHER_SOURCES

    def take_commands(self, step: RecordedStep, t: float, robot: Robot) -> bool:
        """Process the commands of a step at `t`; True: one was refused, so call `sample`."""
        commands, before = step.inputs.commands, dict(self._refused)
        for command in commands:
            self._newest.pop((command.source, command.sender), None)
            self._newest[command.source, command.sender] = command
        while len(self._newest) > MAX_SENDERS:
            del self._newest[next(iter(self._newest))]
        for refusal in step.inputs.refusals:
            if refusal.source:
                self._refuse(refusal.source, t, refusal.text, refusal.reason)
        if commands or step.inputs.refusals or robot is not self._robot:
            self._find_refused(step, t, robot)
        return before != self._refused

    def _find_refused(self, step: RecordedStep, t: float, robot: Robot) -> None:
        # The robot counts refusals by reason, but not by source. A source with a command in this
        # step counts as refused if the last command that the robot accepted from it is older.
        counted = Counter(self._reader.refused(robot))
        new, self._counted = counted - self._counted, counted
        same, self._robot = robot is self._robot, robot
        # The counters of a robot from a recorded state include refusals before this step.
        if not (new and same):
            return
        words = "; ".join(OBJECTIONS[code] for code in new)
        now_ns = step.inputs.now.mono_ns
        ages = {source.name: source.age_s for source in self._reader.sources(robot, now_ns)}
        for command in step.inputs.commands:
            age_s = ages.get(command.source)
            if age_s is None or age_s * NS_PER_S > now_ns - command.arrived_ns + 1:
                self._refuse(command.source, t, words, " ".join(new))

    def _refuse(self, source: str, t: float, words: str, code: str) -> None:
        until = t + self._timeouts.get(source, SAMPLE_PERIOD_S)
        self._refused[self.name(source)] = until, words[:MAX_TEXT_LENGTH], code

    def commanded(self, outputs: Outputs) -> Twist | None:
        """Return the twist of the command that the robot follows, or None."""
        if outputs.command_ns is None:
            return None
        for command in reversed(self._newest.values()):
            if command.arrived_ns == outputs.command_ns and command.source == outputs.source:
                return command.twist
        return None

    def sample(self, step: RecordedStep, t: float, robot: Robot) -> None:
        """Add the present state of each source to `bands`."""
        for name, state, words, code in self._states(step, t, robot):
            self.bands[name].add(t, state, words, code)

    def _states(
        self, step: RecordedStep, t: float, robot: Robot
    ) -> Iterator[tuple[str, str, str, str]]:
        # Name, state, reason and code; a silent source has no state.
        mode, reason, _, driver, code = step.recorded.status
        for source in self._reader.sources(robot, step.inputs.now.mono_ns):
            refusal, wait = self._refusal(source.name, t), source.waits_for
            why = waiting(wait)
            if mode == "driving" and source.name == driver:
                yield source.name, "drives", why.text, why.code
            elif refusal[0]:
                yield source.name, "refused", *refusal
            elif wait.what == "command":
                yield source.name, "", "", ""
            elif mode not in FOLLOWING_MODES or wait.what in ("nothing", "senders"):
                yield source.name, "sends", f"{mode}: {reason}"[:MAX_TEXT_LENGTH], code
            else:
                yield source.name, "waits", why.text, why.code
        refusal = self._refusal(OTHER_SOURCES, t)
        yield OTHER_SOURCES, "refused" if refusal[0] else "", *refusal

    def _refusal(self, name: str, t: float) -> tuple[str, str]:
        until, words, code = self._refused.get(name, (-math.inf, "", ""))
        return (words, code) if t < until else ("", "")
