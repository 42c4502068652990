"""Many commanders -> one command: priority, age, neutral first.

The rules (SAFETY): the live source of the highest priority is heard; among equals the one who
came first keeps the robot until it falls silent; a source that may not drive yet holds its place
with zero, so that nobody below it drives past it. Every refusal has a name to be counted under
and every waiting source has a sentence.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.settings import CommandsConfig, Source
from acsard.values import NS_PER_S, REST, Command, SourceStatus, Twist

FORGET_NS = 10 * NS_PER_S
"""A sender silent for this long may prove a new minimum: its clock may have been set."""

PROVEN_NS = 2 * NS_PER_S
STEADY_NS = NS_PER_S // 10
"""It has when its delays stay within 0.1 s of each other for 2 s; a backlog's fall faster."""

DRIFT = 2e-4
"""How much faster than the sender's clock ours may run; twice what a bad crystal does."""

MAX_SENDERS = 1024
"""Clocks remembered at once; the one heard longest ago goes first."""


REASONS = {
    "unknown_source": "not one of commands.sources",
    "not_finite": "NaN or infinity",
    "stale": "held up on the way for longer than the source's timeout (or the sender's clock was "
    "set back: let it pause for 10 s, then send on)",
}
"""What `accept` refuses for, in words."""


class Choice(Struct, frozen=True):
    """The twist to follow, or None when nobody may drive, and why in words."""

    source: str
    twist: Twist | None
    reason: str
    arrived_ns: int | None = None


class _Clock(Struct, frozen=True):
    """What is known of one sender: its least delay, when it was heard, and a proof under way."""

    least: float
    heard_ns: int
    proof: tuple[float, float, int] | None = None
    """Least and greatest delay since a long silence, and since when."""


class Freshness:
    """Relative age of stamped commands: is this one late compared with the sender's best one?

    d = arrival - stamp holds the unknown clock offset and the delay; d - min(d) is the extra
    delay alone. No clock has to be synchronised, and a clock step here does not matter because
    the arrival is monotonic.

    A sender that returns from a long silence with much greater delays has either set its clock
    back or pours out what the network held: only delays that stay the same tell the first.
    """

    def __init__(self) -> None:
        self._senders: dict[str, _Clock] = {}

    def extra_delay_ns(self, sender: str, stamp_ns: int, arrived_ns: int) -> float:
        """By how much this command came later than the sender's promptest one, ns."""
        delay = float(arrived_ns - stamp_ns)
        known = self._senders.pop(sender, None) or _Clock(delay, arrived_ns)
        silence = arrived_ns - known.heard_ns
        least = min(delay, known.least + DRIFT * silence)
        proof = (delay, delay, arrived_ns) if silence > FORGET_NS else known.proof
        if proof is not None:
            low, high = min(proof[0], delay), max(proof[1], delay)
            if high - low > STEADY_NS:
                proof = (delay, delay, arrived_ns)
            elif delay - least <= STEADY_NS:
                proof = None  # as prompt as ever: nothing to prove
            elif arrived_ns - proof[2] >= PROVEN_NS:
                least, proof = low, None
            else:
                proof = (low, high, proof[2])
        self._senders[sender] = _Clock(least, arrived_ns, proof)
        if len(self._senders) > MAX_SENDERS:
            del self._senders[next(iter(self._senders))]
        return delay - least


class _Commander:
    """What is known of one configured source."""

    def __init__(self, settings: Source) -> None:
        self.settings = settings
        self.timeout_ns = int(settings.timeout * NS_PER_S)
        self.twist = REST
        self.arrived_ns: int | None = None
        self.came_ns = 0
        """First command since it was last silent: who came first among equals."""
        self.armed = False
        self.heard_ns: int | None = None
        """Last command since neutral was last required."""

    def live(self, now_ns: int) -> bool:
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self.timeout_ns


class Arbiter:
    """Holds the latest command of each source and chooses whose is followed."""

    def __init__(self, commands: CommandsConfig) -> None:
        self._neutral_first = commands.neutral_first
        self._commanders = {s.name: _Commander(s) for s in commands.sources}
        self._ranking = sorted(self._commanders.values(), key=lambda c: -c.settings.priority)
        self._holder: _Commander | None = None
        self._since_ns = 0
        self._freshness = Freshness()

    def require_neutral(self, since_ns: int = 0) -> None:
        """Forget all commands; each source must be neutral once before it drives again.

        Only what arrived after `since_ns` counts as neutral or as heard: a zero that was under
        way before the stop was cleared says nothing about now.
        """
        self._since_ns = since_ns
        for commander in self._ranking:
            commander.arrived_ns = commander.heard_ns = None
            commander.armed = not self._neutral_first
        self._holder = None

    def accept(self, command: Command) -> str:
        """Take a command; the key in `REASONS` it is refused for, or "" when it counts."""
        commander = self._commanders.get(command.source)
        if commander is None:
            return "unknown_source"
        twist = command.twist
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            return "not_finite"
        if command.stamp_ns is not None:
            late = self._freshness.extra_delay_ns(
                command.sender or command.source, command.stamp_ns, command.arrived_ns
            )
            if late > commander.timeout_ns:
                return "stale"
        if not commander.armed and command.arrived_ns >= self._since_ns:
            heard, now_ns = commander.heard_ns, command.arrived_ns
            paused = heard is not None and now_ns - heard > commander.timeout_ns
            commander.armed = paused or twist == REST
            commander.heard_ns = now_ns
        if not commander.live(command.arrived_ns):
            commander.came_ns = command.arrived_ns
        commander.twist, commander.arrived_ns = twist, command.arrived_ns
        return ""

    def choose(self, now_ns: int) -> Choice:
        """Whose command counts now, and which."""
        live = [commander for commander in self._ranking if commander.live(now_ns)]
        chosen = min(live, key=lambda c: (-c.settings.priority, c.came_ns), default=None)
        self._holder = chosen
        if chosen is None:
            return Choice("", None, "no commands: no source has sent one within its timeout")
        name = chosen.settings.name
        if not chosen.armed:
            return Choice(name, None, self._wait(chosen))
        return Choice(name, chosen.twist, f"commanded by {name}", chosen.arrived_ns)

    def sources(self, now_ns: int) -> tuple[SourceStatus, ...]:
        """What each source is doing and waiting for, highest priority first."""
        return tuple(
            SourceStatus(
                c.settings.name,
                c.settings.priority,
                None if c.arrived_ns is None else max(0, now_ns - c.arrived_ns) / NS_PER_S,
                self._waits_for(c, now_ns),
            )
            for c in self._ranking
        )

    def _waits_for(self, commander: _Commander, now_ns: int) -> str:
        holder = self._holder
        if not commander.live(now_ns):
            return "a command"
        if not commander.armed:
            return self._wait(commander)
        if holder is None or commander is holder:
            return ""
        if holder.settings.priority == commander.settings.priority:
            return f"{holder.settings.name}, of the same priority, came first: until it is silent"
        return f"{holder.settings.name} has the higher priority: until it is silent"

    @staticmethod
    def _wait(commander: _Commander) -> str:
        settings = commander.settings
        return (
            f"neutral first: {settings.name} must send a zero, or pause for "
            f"{settings.timeout:g} s, before it can drive"
        )
