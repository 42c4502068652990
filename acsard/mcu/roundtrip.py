"""How long the MCU takes to answer, from outside.

A checked reply names the line it answers. A plain one does not, and lines are pipelined: it is held
to answer the youngest line it can, one that left at least a command's and a reply's time on the
wire ago, and after the line answered before. So without the check an MCU that takes longer than a
period shows up too fast by whole periods, and a board on USB, which does not keep to the baud
rate's pace, may show up too slow by one.
"""

from __future__ import annotations

from collections import deque

from acsard.values import NS_PER_S

MOST_NS = NS_PER_S
"""A reply later than this answers nothing."""

LINES = 64
"""Lines remembered; more are never on their way."""


class RoundTrip:
    """Matches replies with lines."""

    def __init__(self, shortest_ns: int) -> None:
        self._shortest_ns = shortest_ns
        self._sent: deque[int] = deque(maxlen=LINES)

    def sent(self, at_ns: int) -> None:
        """A line was handed to the port."""
        self._sent.append(at_ns)

    def replied(self, at_ns: int) -> int | None:
        """The round trip that ended with a reply complete at `at_ns`, in ns; None if no line can
        have caused it."""
        found = None
        while self._sent and at_ns - self._sent[0] >= self._shortest_ns:
            found = at_ns - self._sent.popleft()
        return found if found is not None and found <= MOST_NS else None
