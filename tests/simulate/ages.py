"""Judges the age of commands, and records the zeros of each sender.

A command with an echo is judged by its true age, which the robot never takes for less than it is. A
stamp without an echo shows only how much later a command is than the fastest one of the same clock.
This module follows the law of `explanation/commands.md` of the manual by the stamps that the plan's
senders have made, and is never stricter than that law.
"""

from __future__ import annotations

import math
from typing import Any

from tests.simulate.roads import NS, Message, Sample

MARGIN_NS = 30_000_000
"""Allowed beside a time limit, for a line's way. Where periods matter, a limit allows them too."""

ECHO_NS = 100_000_000
"""A command with an echo is older than its timeout by at most this."""

LOWER_NS, SURELY_LOWER_NS = 40_000_000, 60_000_000
"""A delay that is lower than the least by 50 ms is doubtful; these are less and more."""

RISES = 0.0005
"""Share of the time by which the least delay may rise, for a clock that drifts."""

HOUR_NS = 3600 * NS
"""The least delay may rise by one timeout in this time. A clock that was silent for it is new."""

REMEMBERED = 64
"""Clocks of one source that the robot remembers: it forgets those that it does not refuse."""


class Wish:
    """A command that arrived, with its true properties, which the robot cannot know."""

    __slots__ = ("armed_ns", "arrived_ns", "certain", "fresh", "identity", "shared", "v", "w")

    def __init__(self, arrived_ns: int, v: float, w: float) -> None:
        self.arrived_ns, self.v, self.w = arrived_ns, v, w
        self.fresh = self.certain = self.shared = False
        self.identity = ""
        self.armed_ns = -1
        """Arrival of the zero by which this sender is armed, -1 for none."""


class Sender:
    """The zeros and speeds of one sender identity on one source."""

    def __init__(self) -> None:
        self.zeros: list[tuple[int, int]] = []
        """Zeros that no speed of a shared identity of the source has followed: when the pause of
        each begins, at the earliest, and its arrival."""
        self.armed_ns = -1
        self.heard_ns = -1
        """Arrival of its last command."""
        self.number = 0
        """The highest number that arrived."""
        self.rests = False
        """The command with this number was a zero, or none has arrived."""


class Clock:
    """The delays of one clock's stamps on one source: arrival minus stamp."""

    def __init__(self, at_ns: int, delay_ns: int, others: int) -> None:
        self.last_ns = at_ns
        self.others = others
        """Number of clocks of the source that came before its last command."""
        self.counted = False
        """Its least delay has once not fallen for a whole timeout."""
        self._fell_ns = at_ns
        self.least: tuple[int, int] | None = at_ns, delay_ns
        """The least delay, behind the time at which it was measured."""
        self._lower: list[tuple[int, int]] = []
        """Times and delays of all commands since the first one below the least, if all are."""
        self._confirmed_ns = math.inf
        """The lowest value that such commands may have given to the robot's least delay."""
        self._reached_ns = math.inf
        """The same by small steps down, as when a queue drains: none of them is doubtful."""
        self.known: Clock | None = None
        """The same clock if the robot has not forgotten it for others."""
        self.refused = False
        """Its last command was refused for its age, so the robot never forgets it for others."""

    def take(self, at_ns: int, delay_ns: int, timeout_ns: int) -> bool:
        """Return whether a command with this delay may count."""
        self.last_ns = at_ns
        if self.least is None:  # the robot slept
            self.least, self._confirmed_ns = (at_ns, delay_ns), math.inf
            return True
        since_ns, least_ns = self.least
        if not self.counted:
            if delay_ns < least_ns - SURELY_LOWER_NS:
                self._fell_ns = at_ns
            if delay_ns < least_ns:
                self.least = at_ns, delay_ns
            self.counted = at_ns - self._fell_ns > timeout_ns - MARGIN_NS
            return self.counted and delay_ns <= min(least_ns, delay_ns) + timeout_ns + MARGIN_NS
        passed_ns = at_ns - since_ns
        rises_ns = min(passed_ns * RISES, timeout_ns * (1 + passed_ns // HOUR_NS))
        if delay_ns >= least_ns - LOWER_NS:
            if delay_ns <= least_ns + rises_ns + timeout_ns + MARGIN_NS:
                self._lower.clear()
            self._reached_ns = delay_ns
            if delay_ns < least_ns + rises_ns:
                self.least = at_ns, delay_ns
            return bool(delay_ns <= least_ns + rises_ns + timeout_ns + MARGIN_NS)
        self._lower.append((at_ns, delay_ns))
        if self._reached_ns - SURELY_LOWER_NS <= delay_ns < self._reached_ns:
            self._reached_ns = delay_ns
        confirms_ns = at_ns - self._lower[0][0]
        if confirms_ns > timeout_ns - MARGIN_NS:
            self._confirmed_ns = min(self._confirmed_ns, *(delay for _, delay in self._lower))
        if confirms_ns > 2 * timeout_ns + NS // 5:
            # Now the robot surely knows the lower delays that commands a timeout later confirmed. A
            # single wild stamp is confirmed by none.
            known = [
                delay
                for then, delay in self._lower
                if any(
                    later - then > timeout_ns and abs(other - delay) < timeout_ns
                    for later, other in self._lower
                )
            ]
            if known:
                self.least = at_ns, min(known)
                self._lower.clear()
            else:
                del self._lower[0]
        lowest_ns = min(least_ns, self._confirmed_ns, self._reached_ns)
        return delay_ns >= lowest_ns - SURELY_LOWER_NS


class Ages:
    """The clocks of all senders, as far as one daemon can have learned them."""

    def __init__(self, born_ns: int) -> None:
        self.learned_ns = born_ns
        self._clocks: dict[tuple[str, str], Clock] = {}
        self._number: dict[str, int] = {}
        """Number of clocks of each source so far."""

    def forget_least(self, at_ns: int) -> None:
        """Note that the robot slept until now, so it no longer knows any least delay."""
        self.learned_ns = at_ns
        for clock in self._clocks.values():
            clock.least = clock.known = None

    def fresh(
        self,
        sender: dict[str, Any],
        message: Message,
        sample: Sample,
        arrived_ns: int,
        timeout_ns: int,
    ) -> bool:
        """Return whether the documentation allows the robot to obey this command."""
        if sample.beat is not None:
            return arrived_ns - message.sent_ns <= timeout_ns + ECHO_NS
        if not sample.clock:
            return True
        key, delay_ns = (sender["source"], sample.clock), arrived_ns - message.stamp_ns
        clock, others = self._clocks.get(key), self._number.get(sender["source"], 0)
        if clock is not None and arrived_ns - clock.last_ns > HOUR_NS - NS:
            clock = None
        full = clock is not None and others >= REMEMBERED and others > clock.others
        if clock is None or (full and not clock.refused):
            others = self._number[sender["source"]] = others + 1
            new = self._clocks[key] = Clock(arrived_ns, delay_ns, others)
            new.known = clock and (clock.known or clock)
            fresh = timeout_ns < MARGIN_NS
        else:
            new, fresh = clock, clock.take(arrived_ns, delay_ns, timeout_ns)
        new.others = others
        known = new.known is not None and new.known.take(arrived_ns, delay_ns, timeout_ns)
        new.refused = new.counted and not (fresh or known)
        return fresh or known
