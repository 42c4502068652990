"""Judges the age of commands by the true clock, and records the zeros of each sender.

The robot cannot know the true age of a command, because it compares two clocks. This module allows
the ages that `deploy/clients/README.md` allows, and no more. A command with an echo is fresh if its
true age exceeds the timeout by at most 50 ms. With a stamp it is fresh if its true age exceeds the
lowest delay that the robot has seen by at most the timeout, and by 0.5 ms more for each second. For
a new clock the robot knows no lowest delay, so it accepts any that has not fallen for a timeout.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from tests.simulate.roads import FOREIGN, NS, STEADY, Message, Sample

MARGIN_NS = 30_000_000
"""Allowed beside a time limit, for a line's way. Where periods matter, a limit allows them too."""

EARLY_NS = 60_000_000
"""A delay that falls by more than this is a backlog that pours in."""

BURST_NS = 1_000_000
"""Messages within this time count as one, with the lowest of their delays."""

PAUSE_NS = 2_000_000_000
"""A longer silence is a pause of the sender, if it is also longer than the timeout."""

STAYS_NS = 4_000_000_000
"""Time after which the daemon surely knows lower delays of a foreign clock."""

SILENT_NS = 101 * NS // 10
"""After a silence of this length a sender is certainly not armed."""

REMEMBERED = 15
"""Number of new names after which a sender that paused is new: a source remembers 16 clocks."""


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
        self.last_ns = 0
        """Arrival of its last command."""


class Clock:
    """The true delays of one sender's messages, as far as the robot can have learned them."""

    def __init__(self) -> None:
        self.least_ns: int | None = None
        self.lower: tuple[int, int] | None = None
        """Since when all delays of a foreign clock are lower than that, and the lowest of them."""
        self.recent: deque[tuple[int, int]] = deque()
        self.constant = False
        """Its delays once looked constant for the time of a proof, so the daemon may know them."""
        self.followed = False
        """The robot has followed one of its commands, so the daemon knows its delays."""
        self.names = 0
        """Number of clocks that the robot had met at its last command."""
        self.loose = False
        """It was adjusted, or its sender stamps falsely. The pages promise nothing about the age of
        its commands."""

    def learn(self, age: int, arrived_ns: int, foreign: bool) -> None:
        """Record a true delay.

        The stamps of a foreign clock look fresher if that clock was set. So the daemon believes
        lower delays of a clock that it knows only after they have stayed low.
        """
        least, lower = self.least_ns, self.lower
        known = foreign and (self.followed or self.constant)
        if least is None or not known or age >= least - EARLY_NS:
            self.least_ns, self.lower = age if least is None else min(least, age), None
            return
        since_ns, lowest = lower or (arrived_ns, age)
        self.lower = since_ns, min(lowest, age)
        if arrived_ns - since_ns > STAYS_NS:
            self.least_ns, self.lower = self.lower[1], None


class Ages:
    """The clocks of all senders, as far as one daemon can have learned them."""

    def __init__(self, born_ns: int) -> None:
        self.learned_ns = born_ns
        self.clocks: dict[str, Clock] = {}

    def forget_least(self, at_ns: int) -> None:
        """Note that the robot slept until now, so it no longer knows any lowest delay."""
        self.learned_ns = at_ns
        for clock in self.clocks.values():
            clock.least_ns, clock.constant = None, False

    def fresh(
        self,
        sender: dict[str, Any],
        message: Message,
        sample: Sample,
        arrived_ns: int,
        timeout_ns: int,
        loose: bool,
    ) -> bool:
        """Return whether the documentation allows the robot to obey a command of this true age."""
        if not sample.clock:
            return True
        age = arrived_ns - message.sent_ns
        clock = self.clocks.setdefault(sample.clock, Clock())
        if sender["way"] in STEADY:
            return age <= timeout_ns + EARLY_NS + MARGIN_NS
        clock.loose |= loose
        if len(self.clocks) - clock.names > REMEMBERED:
            clock.least_ns, clock.recent, clock.constant = None, deque(), False
        clock.names = len(self.clocks)
        foreign = sender["way"] in FOREIGN
        pause_ns = max(PAUSE_NS, timeout_ns) - NS // 10
        if (foreign and sender["clock"]) or sender.get("bad_stamps"):
            clock.loose = True
        recent = clock.recent
        least = clock.least_ns
        clock.learn(age, arrived_ns, foreign)
        while recent and recent[0][0] < arrived_ns - max(3 * NS, pause_ns):
            recent.popleft()
        prompt: int = int(sender["delay"] * NS)
        allowed = timeout_ns + EARLY_NS + MARGIN_NS
        if foreign:
            allowed += min(timeout_ns, (arrived_ns - self.learned_ns) // 2000)
        if clock.loose or age <= prompt + allowed:
            fresh = True
        elif least is None:
            fresh = False
        else:
            falls = self._falls(clock, age, arrived_ns, timeout_ns)
            # A delay that the daemon knows is no backlog, also if there were longer ones since.
            fresh = age <= least + allowed and (not falls or (clock.constant and age >= least))
            clock.constant |= not falls
        if recent and arrived_ns - recent[-1][0] < BURST_NS:
            at_ns, before = recent.pop()
            recent.append((at_ns, min(before, age)))
        else:
            recent.append((arrived_ns, age))
        return fresh

    def _falls(self, clock: Clock, age: int, now_ns: int, proof_ns: int) -> bool:
        """Return whether the delays fall, so that the daemon cannot take them for constant.

        The delays must have been constant for the proof time. If the robot has followed this clock,
        they are compared with those of the 3 s before. One late message before a prompt one then
        does not look like a backlog.
        """
        recent = clock.recent
        window = [(at, d) for at, d in recent if at >= now_ns - proof_ns - MARGIN_NS]
        if not window or window[0][0] > now_ns - proof_ns + MARGIN_NS:
            return recent[0][0] > now_ns - proof_ns if recent else True
        middle = now_ns - proof_ns // 2
        first = [d for at, d in (recent if clock.followed else window) if at < middle]
        second = [d for at, d in window if at >= middle] + [age]
        return bool(first) and min(first) - min(second) > EARLY_NS
