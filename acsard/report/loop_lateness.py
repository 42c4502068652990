"""Computes how late the control loop ran each of its periods."""

from __future__ import annotations

import math

from acsard.core.thinning import Curve, Point
from acsard.core.values import NS_PER_S

NS_PER_MS = 1_000_000


class Lateness:
    """Delay of each period's step, relative to the step with the smallest delay.

    The recording has the number of missed periods, so the number of each period is known. Its due
    time is then known except for a constant offset. The step with the smallest delay gives this
    offset.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()
        self._number = 0
        """Number of the last period."""
        self._ahead = 0
        """Number of lines since then that were sent at once, in place of a later period's line."""
        self._began_ns: int | None = None
        self._earliest = math.inf
        """Smallest delay, ns."""
        self.missed = 0
        """Number of periods without a step."""
        self.most_missed = 0
        """Largest number of consecutive periods without a step."""

    def at_once(self) -> None:
        """Register a line that was sent at once, in place of the next period's line."""
        self._ahead += 1

    def tick(self, t: float, now_ns: int, missed: int, known: bool) -> None:
        """Take the step of a period.

        Args:
            t: time of the step, s.
            now_ns: monotonic time of the step, ns.
            missed: number of periods since the previous tick that had no step.
            known: False if the recording lacks steps before this one. Then the number of the period
                is computed from the clock.
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
            # The line that was sent at once took the place of a missed period.
            self._number -= 1
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self.most_missed = max(self.most_missed, missed)
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """Return the delay in ms over the time in s."""
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most_ms(self) -> float:
        """Largest delay, ms."""
        return max([point.value for point in self.points()], default=0.0)
