"""Is a stamped command late, compared with the promptest by the same clock? Too late is stale.

No clock has to be synchronised (`mcu/promptest.py`), and a clock step here does not matter because
the arrival is monotonic. One who returns from a long silence with much greater delays has either
set the clock back or pours out what the network held: only delays that stay the same tell the
first. What is known of a clock:

    known    its promptest command is believed
    proving  late after a long silence: it may prove a new promptest

"""

from __future__ import annotations

from typing import Literal

from acsard.mcu.promptest import Promptest
from acsard.values import NS_PER_S, Command

FORGET_NS = 10 * NS_PER_S
"""A clock not heard of for this long may prove a new minimum: it may have been set."""

PROVEN_NS = 2 * NS_PER_S
STEADY_NS = NS_PER_S // 10
"""It has when its delays stay within 0.1 s of each other for 2 s; a backlog's fall faster."""

DRIFT = 2e-4
"""How much faster than the sender's clock ours may run; twice what a bad crystal does."""

MAX_CLOCKS = 1024
"""Clocks remembered at once; the one heard of longest ago goes first."""

State = Literal["known", "proving"]
Sign = Literal["usual", "returned", "prompt", "wavering", "steady", "proven"]

NEXT: dict[tuple[State, Sign], State] = {
    ("known", "usual"): "known",
    ("known", "prompt"): "known",
    ("known", "returned"): "proving",
    ("proving", "returned"): "proving",  # silent again: from here
    ("proving", "wavering"): "proving",  # as a backlog's delays: from here
    ("proving", "steady"): "proving",
    ("proving", "prompt"): "known",  # as prompt as ever: nothing to prove
    ("proving", "proven"): "known",  # it was set: the promptest since then is believed
}
"""What a command shows of its clock, and what that leads to."""


class _Clock:
    """What is known of one clock, by the commands it stamped."""

    def __init__(self, stamp_ns: int, arrived_ns: int) -> None:
        self._state: State = "known"
        self._promptest = Promptest(DRIFT)
        self._stamp_ns, self._heard_ns = stamp_ns, arrived_ns
        self._least = self._most = self._since_ns = 0
        """The delays since when it has been proving."""

    def late_ns(self, stamp_ns: int, arrived_ns: int) -> float:
        """How late this command came."""
        silence, delay = arrived_ns - self._heard_ns, arrived_ns - stamp_ns
        self._promptest.add(silence, stamp_ns - self._stamp_ns)
        self._stamp_ns, self._heard_ns = stamp_ns, arrived_ns
        sign = self._sign(silence, delay)
        self._state = NEXT[self._state, sign]
        if sign in ("returned", "wavering"):
            self._least, self._most, self._since_ns = delay, delay, arrived_ns
        elif sign == "proven":
            self._promptest.late = delay - self._least
        return self._promptest.late

    def _sign(self, silence: int, delay: int) -> Sign:
        prompt = self._promptest.late <= STEADY_NS
        if silence > FORGET_NS:
            return "prompt" if prompt else "returned"
        if self._state == "known":
            return "usual"
        self._least, self._most = min(self._least, delay), max(self._most, delay)
        if self._most - self._least > STEADY_NS:
            return "wavering"
        if prompt:
            return "prompt"
        return "proven" if self._heard_ns - self._since_ns >= PROVEN_NS else "steady"


class Freshness:
    """The clocks of all that stamp commands."""

    def __init__(self) -> None:
        self._clocks: dict[str, _Clock] = {}

    def stale(self, command: Command, timeout_ns: int) -> bool:
        """The command came later than its clock's promptest by more than the timeout."""
        if command.stamp_ns is None:
            return False
        name = command.clock or command.source
        return self.late_ns(name, command.stamp_ns, command.arrived_ns) > timeout_ns

    def late_ns(self, name: str, stamp_ns: int, arrived_ns: int) -> float:
        """By how much this command came later than the clock's promptest one, ns."""
        clock = self._clocks.pop(name, None) or _Clock(stamp_ns, arrived_ns)
        self._clocks[name] = clock
        if len(self._clocks) > MAX_CLOCKS:
            del self._clocks[next(iter(self._clocks))]
        return clock.late_ns(stamp_ns, arrived_ns)
