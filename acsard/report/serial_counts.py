"""Counts the lines of the serial port for each second of a recording."""

from __future__ import annotations

from collections.abc import Mapping

from acsard.core.thinning import Curve


class SerialTotals:
    """Number of sent, accepted, dropped and unanswered lines of the collected steps."""

    def __init__(self) -> None:
        self.sent = self.good = self.dropped = self.unanswered = 0


class SerialCounts:
    """Number of sent, accepted, dropped and unanswered lines in each second."""

    def __init__(self) -> None:
        self.sent, self.good, self.dropped, self.unanswered = Curve(), Curve(), Curve(), Curve()
        self.totals = SerialTotals()
        self._second: int | None = None
        self._sent = 0
        """Lines sent in this second."""
        self._base = 0
        """Lines received before the first collected step."""
        self._before = (0, 0)
        """Good and dropped lines since the daemon's start, at the beginning of this second."""
        self._now = (0, 0)
        """Good and dropped lines since the daemon's start, at the last step."""
        self._outstanding: int | None = None
        """Smallest number of unanswered lines at any step of this second.

        At another step the answer to the newest line may just not have arrived yet. The smallest
        number counts only the lines whose answers are lost.
        """
        self._lost: int | None = None
        """Largest `_outstanding` of all earlier seconds."""

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """Take a step.

        Args:
            t: time of the step, s.
            sent: True if a line was sent.
            counters: the robot's counters after the step.
        """
        received = self._now = _received(counters)
        if self._second is None:
            self._second, self._before, self._base = int(t), received, sum(received)
        elif int(t) != self._second:
            self._end(received)
            self._second = int(t)
        outstanding = self.totals.sent + self._sent - (sum(received) - self._base)
        if self._outstanding is None or outstanding < self._outstanding:
            self._outstanding = outstanding
        self._sent += sent

    def _end(self, received: tuple[int, int]) -> None:
        """Finish a second. The next step may be many seconds later."""
        t, totals = float(self._second or 0) + 0.5, self.totals
        good, dropped = (now - then for now, then in zip(received, self._before, strict=True))
        outstanding = self._outstanding or 0
        lost = outstanding if self._lost is None else max(outstanding, self._lost)
        unanswered = 0 if self._lost is None else lost - self._lost
        for curve, count in (
            (self.sent, self._sent),
            (self.good, good),
            (self.dropped, dropped),
            (self.unanswered, unanswered),
        ):
            curve.add(t, count)
        totals.sent += self._sent
        totals.good += good
        totals.dropped += dropped
        totals.unanswered += unanswered
        self._sent, self._before, self._lost, self._outstanding = 0, received, lost, None

    def end(self) -> None:
        """Finish the last second."""
        if self._second is not None:
            self._end(self._now)


def _received(counters: Mapping[str, int]) -> tuple[int, int]:
    """Return the number of accepted and dropped lines. An implausible line could be read, too."""
    bad = sum(count for name, count in counters.items() if name.startswith("line_"))
    return counters.get("lines", 0) - counters.get("line_implausible", 0), bad
