"""The serial line second by second, and how late the control loop was."""

from __future__ import annotations

import math
from collections.abc import Mapping

from acsard.report.thinning import Curve, Point
from acsard.values import NS_PER_S

GOOD = "lines"
"""What `Snapshot.counters` has of lines that were read and understood."""

BAD = "line_"
"""Begins the counters of those that were dropped."""

IMPOSSIBLE = "line_impossible"
"""Of those that were understood, and could not be true."""

NS_PER_MS = 1_000_000


class Totals:
    """Counts of a part of a recording."""

    def __init__(self) -> None:
        self.sent = self.good = self.dropped = self.unanswered = 0


class Link:
    """Lines sent, answered, dropped and without an answer, each second."""

    def __init__(self) -> None:
        self.sent, self.good, self.dropped, self.unanswered = Curve(), Curve(), Curve(), Curve()
        self.totals = Totals()
        self._second: int | None = None
        self._sent = self._base = 0
        self._heard = (0, 0)
        """Good and dropped, all there ever were, when this second began."""
        self._now = (0, 0)
        """The same by now."""
        self._least: int | None = None
        """The fewest lines that had no answer at any time of this second: the newest line may just
        be under way, the others are lost."""
        self._open: int | None = None
        """The most of these fewest, of all seconds before."""

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """A step at `t`, whether a line left with it, and what was counted by then."""
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
        """Of a second, which may be followed by others without a step."""
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
        """No more steps: what the last second has counts too."""
        if self._second is not None:
            self._end(self._now)


def _heard(counters: Mapping[str, int]) -> tuple[int, int]:
    """Lines that were believed, and those that were dropped."""
    bad = sum(count for name, count in counters.items() if name.startswith(BAD))
    return counters.get(GOOD, 0) - counters.get(IMPOSSIBLE, 0), bad


class Lateness:
    """How late each period's step was, in ms, against the clock that the earliest of them keep.

    Periods without a step of their own are counted, so their number is known, and with it the clock
    but for where it begins: there the step that was least late shows it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()
        self._number = 0
        self._ahead = 0
        self._began_ns: int | None = None
        self._earliest = math.inf
        self.missed = 0
        """Periods without a step."""
        self.most_missed = 0
        """In a row."""

    def at_once(self) -> None:
        """A line went at once: it takes the place of a period's."""
        self._ahead += 1

    def tick(self, t: float, now_ns: int, missed: int, known: bool) -> None:
        """A period's step; `missed` ended before it. Where steps are missing it is not `known`."""
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
            self._number -= 1  # the line that went at once was in a period that was missed
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self.most_missed = max(self.most_missed, missed)
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """ms, by time."""
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most(self) -> float:
        """ms"""
        return max([point.value for point in self.points()], default=0.0)
