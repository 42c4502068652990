"""Many commanders -> one command: priority, age, neutral first.

The rules (SAFETY): the live source of the highest priority is heard; among equals the one who
came first keeps the robot until it falls silent, and so among the senders of one source; a source
that may not drive yet holds its place with zero, so that nobody below it drives past it. Each
sender must be neutral for itself. Every refusal has a name to be counted under and every waiting
source has a sentence.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.config.settings import CommandsConfig, Source
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

MAX_VOICES = 16
"""Senders remembered of one source; nobody pushes out one that is live and may drive."""

REASONS = {
    "unknown_source": "not one of commands.sources",
    "not_finite": "NaN or infinity",
    "crowded": f"{MAX_VOICES} other senders of this source are live",
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


class _Voice:
    """One sender of a source: two programs, or two people, on one key are two voices."""

    def __init__(self, arrived_ns: int, armed: bool) -> None:
        self.twist = REST
        self.arrived_ns: int | None = None
        self.came_ns = arrived_ns
        """First command since it was last silent: who came first."""
        self.armed = armed
        self.heard = False
        """A command of it has counted since neutral was last required."""
        self.noticed_ns = 0
        """Last sign of it, whether that counted or not."""
        self.stamp_ns: int | None = None
        """When it says that it sent the last command that counted."""


class _Commander:
    """What is known of one configured source."""

    def __init__(self, settings: Source, neutral_first: bool) -> None:
        self.settings = settings
        self.timeout_ns = int(settings.timeout * NS_PER_S)
        self._neutral_first = neutral_first
        self.voices: dict[str, _Voice] = {}

    def voice(self, name: str, now_ns: int) -> _Voice | None:
        """The sender of this name, for whom one of less account makes room; None for no room."""
        known = self.voices.get(name)
        if known is None:
            if len(self.voices) >= MAX_VOICES:
                least = min(self.voices, key=lambda other: self._account(other, now_ns))
                if self._account(least, now_ns)[0]:
                    return None
                del self.voices[least]
            known = self.voices[name] = _Voice(now_ns, armed=not self._neutral_first)
        return known

    def _account(self, name: str, now_ns: int) -> tuple[bool, bool, int]:
        """Who may be driving counts most, then who may drive, then who was there last."""
        voice = self.voices[name]
        return voice.armed and self.live(voice, now_ns), voice.armed, voice.noticed_ns

    def live(self, voice: _Voice, now_ns: int) -> bool:
        return voice.arrived_ns is not None and now_ns - voice.arrived_ns <= self.timeout_ns

    def speaking(self, now_ns: int) -> _Voice | None:
        """Who of the live ones is followed: who may drive, and of those who came first."""
        live = [voice for voice in self.voices.values() if self.live(voice, now_ns)]
        return min(live, key=lambda voice: (not voice.armed, voice.came_ns), default=None)

    def latest_ns(self) -> int | None:
        """When a command last counted, of whichever voice."""
        times = [v.arrived_ns for v in self.voices.values() if v.arrived_ns is not None]
        return max(times, default=None)

    def forget(self) -> None:
        """Every voice must be neutral once before it drives again."""
        for voice in self.voices.values():
            voice.arrived_ns = voice.stamp_ns = None
            voice.heard = False
            voice.armed = not self._neutral_first


class Arbiter:
    """Holds the latest command of each source and chooses whose is followed."""

    def __init__(self, commands: CommandsConfig) -> None:
        self._commanders = {s.name: _Commander(s, commands.neutral_first) for s in commands.sources}
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
            commander.forget()
        self._holder = None

    def accept(self, command: Command) -> str:
        """Take a command; the key in `REASONS` it is refused for, or "" when it counts."""
        commander = self._commanders.get(command.source)
        if commander is None:
            return "unknown_source"
        now_ns, twist = command.arrived_ns, command.twist
        reason = self._objection(command, commander)
        if reason:
            self.notice(command.source, command.voice, now_ns)
            return reason
        voice = commander.voice(command.voice, now_ns)
        if voice is None:
            return "crowded"
        if not voice.armed and now_ns >= self._since_ns:
            still = twist == REST and not command.cancelled
            voice.armed = still or self._paused(command, voice, commander.timeout_ns)
            voice.heard = True
        voice.noticed_ns = now_ns
        if not commander.live(voice, now_ns):
            voice.came_ns = now_ns
        voice.twist, voice.arrived_ns, voice.stamp_ns = twist, now_ns, command.stamp_ns
        return ""

    def notice(self, source: str, voice: str, arrived_ns: int) -> None:
        """A command that could not even be read: no sender who does that is silent."""
        commander = self._commanders.get(source)
        if commander is not None and voice in commander.voices:
            commander.voices[voice].noticed_ns = arrived_ns

    def _objection(self, command: Command, commander: _Commander) -> str:
        twist = command.twist
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            return "not_finite"
        if command.stamp_ns is not None:
            late = self._freshness.extra_delay_ns(
                command.sender or command.source, command.stamp_ns, command.arrived_ns
            )
            if late > commander.timeout_ns:
                return "stale"
        return ""

    @staticmethod
    def _paused(command: Command, voice: _Voice, timeout_ns: int) -> bool:
        """It was heard, and then was silent by its own doing and not the network's."""
        if not voice.heard or command.arrived_ns - voice.noticed_ns <= timeout_ns:
            return False
        sent, before = command.stamp_ns, voice.stamp_ns
        return sent is None or before is None or sent - before > timeout_ns

    def choose(self, now_ns: int) -> Choice:
        """Whose command counts now, and which."""
        live = [(c, v) for c in self._ranking if (v := c.speaking(now_ns)) is not None]
        if not live:
            self._holder = None
            return Choice("", None, "no commands: no source has sent one within its timeout")
        chosen, voice = min(live, key=lambda one: (-one[0].settings.priority, one[1].came_ns))
        self._holder = chosen
        name = chosen.settings.name
        if not voice.armed:
            return Choice(name, None, self._wait(chosen))
        return Choice(name, voice.twist, f"commanded by {name}", voice.arrived_ns)

    def sources(self, now_ns: int) -> tuple[SourceStatus, ...]:
        """What each source is doing and waiting for, highest priority first."""
        return tuple(self._status(commander, now_ns) for commander in self._ranking)

    def _status(self, commander: _Commander, now_ns: int) -> SourceStatus:
        latest = commander.latest_ns()
        return SourceStatus(
            commander.settings.name,
            commander.settings.priority,
            None if latest is None else max(0, now_ns - latest) / NS_PER_S,
            self._waits_for(commander, now_ns),
        )

    def _waits_for(self, commander: _Commander, now_ns: int) -> str:
        holder, voice = self._holder, commander.speaking(now_ns)
        if voice is None:
            return "a command"
        if not voice.armed:
            return self._wait(commander)
        if holder is None or commander is holder:
            return self._others(commander, voice, now_ns)
        if holder.settings.priority == commander.settings.priority:
            return f"{holder.settings.name}, of the same priority, came first: until it is silent"
        return f"{holder.settings.name} has the higher priority: until it is silent"

    def _others(self, commander: _Commander, voice: _Voice, now_ns: int) -> str:
        """What the other senders of a source that is followed wait for; "" without any."""
        others = [
            other
            for other in commander.voices.values()
            if other is not voice and commander.live(other, now_ns)
        ]
        if not others:
            return ""
        return f"{len(others)} more of its senders: the first until it is silent"

    @staticmethod
    def _wait(commander: _Commander) -> str:
        settings = commander.settings
        return (
            f"neutral first: {settings.name} must send a zero, or pause for "
            f"{settings.timeout:g} s, before it can drive"
        )
