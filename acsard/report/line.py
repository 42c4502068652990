"""Per-second counts of the serial line, and the lateness of the control loop."""

from __future__ import annotations

import math
from collections.abc import Mapping

from acsard.thinning import Curve, Point
from acsard.values import NS_PER_S

GOOD = "lines"
"""Name of the counter of lines that were parsed."""

BAD = "line_"
"""Prefix of the counters of dropped lines."""

IMPOSSIBLE = "line_impossible"
"""Counter of lines that were parsed but whose content was impossible."""

NS_PER_MS = 1_000_000


class Totals:
    """Totals of a part of a recording."""

    def __init__(self) -> None:
        self.sent = self.good = self.dropped = self.unanswered = 0


class Link:
    """Lines sent, answered, dropped and unanswered, for each second."""

    def __init__(self) -> None:
        self.sent, self.good, self.dropped, self.unanswered = Curve(), Curve(), Curve(), Curve()
        self.totals = Totals()
        self._second: int | None = None
        self._sent = self._base = 0
        self._heard = (0, 0)
        """Good and dropped lines since the daemon's start, at the beginning of this second."""
        self._now = (0, 0)
        """Good and dropped lines since the daemon's start, at the last step."""
        self._least: int | None = None
        """Smallest number of unanswered lines at any step of this second. The newest line may just
        be under way; the others are lost."""
        self._open: int | None = None
        """Maximum of `_least` over all earlier seconds."""

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """Process a step: its time in s, whether a line was sent, and the counters after it."""
        heard = self._now = _heard(counters)
        if self._second is None:
            self._second, self._heard, self._base = int(t), heard, sum(heard)
        elif int(t) != self._second:
            self._end(heard)
            self._second = int(t)
        if self._least is None or self._outstanding(heard) < self._least:
            self._least = self._outstanding(heard)
        self._sent += sent

    def _outstanding(self, heard: tuple[int, int]) -> int:
        return self.totals.sent + self._sent - (sum(heard) - self._base)

    def _end(self, heard: tuple[int, int]) -> None:
        """Close a second; seconds without a step may follow."""
        t, totals = float(self._second or 0) + 0.5, self.totals
        good, dropped = (now - then for now, then in zip(heard, self._heard, strict=True))
        least = self._least or 0
        most = least if self._open is None else max(least, self._open)
        lost = 0 if self._open is None else most - self._open
        for curve, count in (
            (self.sent, self._sent),
            (self.good, good),
            (self.dropped, dropped),
            (self.unanswered, lost),
        ):
            curve.add(t, count)
        totals.sent += self._sent
        totals.good += good
        totals.dropped += dropped
        totals.unanswered += lost
        self._sent, self._heard, self._open, self._least = 0, heard, most, None

    def end(self) -> None:
        """Close the last second."""
        if self._second is not None:
            self._end(self._now)


def _heard(counters: Mapping[str, int]) -> tuple[int, int]:
    """Return the number of accepted and of dropped lines."""
    bad = sum(count for name, count in counters.items() if name.startswith(BAD))
    return counters.get(GOOD, 0) - counters.get(IMPOSSIBLE, 0), bad


class Lateness:
    """Lateness of each period's step in ms, relative to the earliest step.

    Missed periods are counted, so the number of each period is known. Its due time is then known
    except for a constant offset, which the least late step determines.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()
        self._number = 0
        self._ahead = 0
        self._began_ns: int | None = None
        self._earliest = math.inf
        self.missed = 0
        """Number of periods without a step."""
        self.most_missed = 0
        """Largest number of consecutive periods without a step."""

    def at_once(self) -> None:
        """Note that a line was sent at once, in place of the next period's line."""
        self._ahead += 1

    def tick(self, t: float, now_ns: int, missed: int, known: bool) -> None:
        """Process the step of a period, before which `missed` periods ended without a step.

        `known` is False if steps are missing from the recording; then the period is derived from
        the clock.
        """
        period_ns, began_ns = self._period_ns, self._began_ns
        if began_ns is None:
            began_ns = self._began_ns = now_ns
            missed = 0
        elif known:
            self._number += 1 + missed + self._ahead
        else:
            self._number, missed = round((now_ns - began_ns) / period_ns), 0
        behind_ns = now_ns - began_ns - self._number * period_ns
        if missed and self._ahead and behind_ns < self._earliest - period_ns / 2:
            self._number -= 1  # the line sent at once belonged to a missed period
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self.most_missed = max(self.most_missed, missed)
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """Return the lateness in ms over time in s."""
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most(self) -> float:
        """Largest lateness, ms."""
        return max([point.value for point in self.points()], default=0.0)
