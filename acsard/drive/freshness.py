"""Is a stamped command fresh? By two clocks that nobody has compared.

Arrival less departure holds the delay and how far the clocks are apart. That nobody knows, but the
promptest delay so far tells how much longer this one took. Whose promptest is to be believed must
first have shown steady delays: a backlog's fall while it pours out, a prompt sender's stay.

    new      not heard before, or not for long
    known    its promptest delay is believed
    stepped  too late or too early by that: held up on the way, or its clock was set

No clock has to be synchronised, and a step of ours does not matter: arrivals are monotonic.
"""

from __future__ import annotations

from typing import Literal

from acsard.mcu.promptest import Promptest
from acsard.values import NS_PER_S, Command

DRIFT = 2e-4
"""How far apart the sender's clock and ours may go; twice what a bad crystal does."""

FORGET_NS = 250 * NS_PER_S
"""After so long a silence the drift may be 50 ms: who comes back is as good as new."""

EARLY_NS = NS_PER_S // 20
"""What falls by more than this is no jitter: a backlog that pours out, or a clock set forward."""

STEADY, SLEWED = 0.01, 0.1
"""By which share of the time delays may change and still be steady: of a clock whose delay jumped
or was never known, and of one that crept away, as it does while NTP slews it (by 8 %)."""

JITTER_NS = NS_PER_S // 200
"""Creeping is what changes by no more than this beside that share."""

LONGEST_PROOF_NS = 2 * NS_PER_S
"""A proof takes the timeout of the source, but no longer than this."""

JUMP_PROOF_NS = 3 * NS_PER_S // 2
"""Who jumped takes so long: rather a backlog, let in by heaps, than a clock that was set."""

ROSE_NS, AGAIN_NS = NS_PER_S // 50, JUMP_PROOF_NS // 2
"""Who jumped and whose delays are all longer by so much, for so long, begins the proof again: no
jitter, but a clock that was slewed, and goes evenly again."""

GAP_NS = 2 * NS_PER_S
"""Who is silent for longer begins the proof again."""

MAX_CLOCKS = 1024
"""Clocks remembered at once; the one heard of longest ago goes first. As many as senders may name
within a twentieth of a second, and more: none is forgotten between two of its commands."""

State = Literal["new", "known", "stepped"]
Sign = Literal["usual", "wavering", "steady", "proven"]
Verdict = Literal["fresh", "first", "unproven", "stale", "set"]
"""`fresh` counts. `unproven` does not yet, nor does `first`, with which a proof begins. `set`
counts: the clock has been set, and who set it begins anew."""

NEXT: dict[tuple[State, Sign], tuple[State, Verdict]] = {
    ("new", "wavering"): ("new", "first"),
    ("new", "steady"): ("new", "unproven"),
    ("new", "proven"): ("known", "fresh"),
    ("known", "usual"): ("known", "fresh"),
    ("known", "wavering"): ("stepped", "stale"),
    ("stepped", "usual"): ("known", "fresh"),  # as prompt as ever: nothing to prove
    ("stepped", "wavering"): ("stepped", "stale"),
    ("stepped", "steady"): ("stepped", "stale"),
    ("stepped", "proven"): ("known", "set"),
}
"""What a command shows of its clock: where that leads, and what becomes of the command."""


class _Proof:
    """Whether delays are steady, from the one it began with on."""

    def __init__(self) -> None:
        self._share, self._least_ns = STEADY, 0
        self._first = self._delay = self._since_ns = 0
        self._heard_ns = -GAP_NS - 1  # too long ago: the first one begins it
        self._met_ns: int | None = None
        """When a delay was first met again: what falls passes each but once."""
        self._prompt_ns = 0
        """When one was last about as prompt."""

    def begin(self, delay: int, at_ns: int, share: float = STEADY, least_ns: int = 0) -> Sign:
        """From this command on, for no less than that."""
        self._share, self._least_ns, self._first = share, least_ns, delay
        self._look_from(delay, at_ns)
        return "wavering"

    def _look_from(self, delay: int, at_ns: int) -> None:
        self._delay, self._since_ns, self._heard_ns, self._met_ns = delay, at_ns, at_ns, None
        self._prompt_ns = at_ns

    def add(self, delay: int, at_ns: int, timeout_ns: int) -> Sign:
        """One more; what wavers begins it again.

        So does what falls a little, but as no more than the jitter of what came before.
        """
        more, lasted_ns = delay - self._delay, at_ns - self._since_ns
        silence, self._heard_ns = at_ns - self._heard_ns, at_ns
        allowed = self._share * lasted_ns
        if more > timeout_ns or silence > GAP_NS or delay < self._first - EARLY_NS:
            return self.begin(delay, at_ns, self._share, self._least_ns)
        if more < -allowed:
            self._look_from(delay, at_ns)
            return "steady"
        if more <= ROSE_NS:
            self._prompt_ns = at_ns
        elif self._least_ns and at_ns - self._prompt_ns > AGAIN_NS:
            return self.begin(delay, at_ns, self._share, self._least_ns)
        if more > allowed:
            return "steady"  # jitter, unless none is as prompt again
        if self._met_ns is None:
            self._met_ns = at_ns
        needed_ns = max(self._least_ns, min(timeout_ns, LONGEST_PROOF_NS))
        met_again = at_ns - self._met_ns >= needed_ns // 2
        return "proven" if met_again and lasted_ns >= needed_ns else "steady"


class _Clock:
    """What is known of one clock, by the commands it stamped."""

    def __init__(self, at_ns: int) -> None:
        self._state: State = "new"
        self._promptest = Promptest(DRIFT)
        """Of those believed, in ns."""
        self._late = self._early = 0.0
        """By how much the last one came later; by how much lately some came ever earlier."""
        self._heard_ns, self._delay = at_ns, 0
        self._proof = _Proof()

    @property
    def new(self) -> bool:
        """Its delays have not been believed yet, or not for long."""
        return self._state == "new"

    @property
    def heard_ns(self) -> int:
        """When it was heard last."""
        return self._heard_ns

    def judge(self, delay: int, at_ns: int, timeout_ns: int) -> Verdict:
        """What to do with a command that took so long by the two clocks."""
        silence, self._heard_ns = at_ns - self._heard_ns, at_ns
        if silence > FORGET_NS:
            self._state, self._proof = "new", _Proof()
        sign = self._sign(delay, at_ns, silence, timeout_ns)
        self._state, verdict = NEXT[self._state, sign]
        self._delay = delay
        if sign == "proven":
            self._promptest, self._late, self._early = Promptest(DRIFT), 0.0, 0.0
        return verdict

    def _sign(self, delay: int, at_ns: int, silence: int, timeout_ns: int) -> Sign:
        if self._state == "new":
            return self._proof.add(delay, at_ns, timeout_ns)
        departed = silence - (delay - self._delay)  # so long after the last, by the sender's clock
        before, self._late = self._late, self._promptest.measure(silence, departed)
        early = max(0.0, self._early - SLEWED * silence) + max(0.0, -self._late)
        if self._late <= timeout_ns and early <= EARLY_NS:
            self._promptest.believe()
            self._early = early
            return "usual"
        if self._state == "stepped":
            return self._proof.add(delay, at_ns, timeout_ns)
        crept = abs(self._late - before) <= SLEWED * silence + JITTER_NS
        if crept:
            return self._proof.begin(delay, at_ns, SLEWED)
        return self._proof.begin(delay, at_ns, STEADY, JUMP_PROOF_NS)


class Freshness:
    """The clocks of all that stamp commands."""

    def __init__(self) -> None:
        self._clocks: dict[str, _Clock] = {}
        self._newcomers: dict[str, _Clock] = {}

    def judge(self, command: Command, timeout_ns: int) -> Verdict:
        """What to do with a command; without a stamp it is as old as its arrival."""
        if command.stamp_ns is None:
            return "fresh"
        name, at_ns = command.clock or command.source, command.arrived_ns
        clock = self._clocks.pop(name, None) or self._newcomers.pop(name, None) or _Clock(at_ns)
        verdict = clock.judge(at_ns - command.stamp_ns, at_ns, timeout_ns)
        held = self._newcomers if clock.new else self._clocks
        held[name] = clock
        self._forget(at_ns)
        return verdict

    def _forget(self, now_ns: int) -> None:
        """Those who would begin anew if they came back, so that it changes nothing: a recording
        begins with all that is remembered, which the loop writes in one step."""
        for held, silent_ns in ((self._newcomers, GAP_NS), (self._clocks, FORGET_NS)):
            while held and now_ns - _oldest(held).heard_ns > silent_ns:
                del held[next(iter(held))]
        if len(self._newcomers) + len(self._clocks) > MAX_CLOCKS:
            both = [held for held in (self._newcomers, self._clocks) if held]
            held = min(both, key=lambda one: _oldest(one).heard_ns)
            del held[next(iter(held))]


def _oldest(held: dict[str, _Clock]) -> _Clock:
    """The one heard of longest ago: whoever is heard goes last."""
    return next(iter(held.values()))
