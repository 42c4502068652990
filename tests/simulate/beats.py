"""The beats of the daemons of a run, and which of them a sender has received.

A daemon publishes a beat every 50 ms: the number of its run, and its time by the clock that goes on
while the host sleeps. A program that echoes copies the beat that it received last into its command.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from tests.simulate.roads import NS, congestion_delay

EVERY_NS = NS // 20

OLDEST = 600
"""Beats among which the newest one that a sender has received is looked for."""


class Beat(NamedTuple):
    run: int
    at_ns: int
    """True time."""


class Beats:
    """The times in which each run of the daemon publishes beats."""

    def __init__(self) -> None:
        self._spans: list[tuple[int, int, int | None]] = []
        """Run, begin, and end or None."""
        self.run = 0

    def begin(self, at_ns: int) -> None:
        """Note that a daemon starts."""
        self.run += 1
        self._spans.append((self.run, at_ns, None))

    def end(self, at_ns: int) -> None:
        """Note that the daemon ends."""
        run, begin_ns, end_ns = self._spans[-1]
        if end_ns is None:
            self._spans[-1] = run, begin_ns, at_ns

    def sleep(self, begin_ns: int, end_ns: int) -> None:
        """Note that the host slept."""
        self.end(begin_ns)
        self._spans.append((self.run, end_ns, None))

    def newest(self, sender: dict[str, Any], sent_ns: int) -> Beat | None:
        """Return the newest beat that this sender has received when it sends."""
        delay_ns, both = int(sender["delay"] * NS), sender.get("both_ways", False)
        for run, begin_ns, end_ns in reversed(self._spans):
            last_ns = sent_ns - delay_ns if end_ns is None else min(end_ns, sent_ns - delay_ns)
            place = (last_ns - begin_ns) // EVERY_NS
            for n in range(place, max(-1, place - OLDEST), -1):
                at_ns = begin_ns + n * EVERY_NS
                waits_ns = int(congestion_delay(sender, at_ns / NS) * NS) if both else 0
                if at_ns + delay_ns + waits_ns <= sent_ns:
                    return Beat(run, at_ns)
        return None
