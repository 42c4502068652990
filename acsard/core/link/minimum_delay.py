"""Measures how late events are by two unrelated clocks, relative to the minimum delay so far.

The arrival time by our clock minus the departure time by theirs is the delay plus an unknown offset
between the clocks. The offset cancels out in the comparison with the smallest value so far, so the
result is the delay in excess of the minimum. Clocks drift, so the minimum counts for less as time
passes.
"""

from __future__ import annotations

import math

DRIFT = 0.01
"""Relative drift between two clocks that is allowed. A ceramic resonator has half of it."""


class MinimumDelay:
    """The lateness of the last event, in the caller's unit of time."""

    def __init__(self, drift: float = DRIFT, most: float = math.inf) -> None:
        """Start.

        `drift` is the relative drift of the clocks, and a lateness above `most` counts as `most`.
        """
        self._drift, self._most = drift, most
        self.late = 0.0
        """Lateness of the last event over the minimum delay."""

    def add(self, ours: float, theirs: float) -> float:
        """Take an event and return its lateness over the minimum so far.

        A negative result makes this event the new minimum. The lateness includes the drift of the
        clocks since the last event.

        Args:
            ours: time since the last event by our clock.
            theirs: time since the last event by the other clock.
        """
        later = self.late + ours - theirs
        self.measure(ours, theirs)
        self.believe()
        return later

    def measure(self, ours: float, theirs: float) -> float:
        """Return the lateness of an event, less drift.

        A negative result is below the accepted minimum.
        """
        self.late = self.late + ours - theirs - self._drift * ours
        return self.late

    def believe(self) -> None:
        """Accept the last measured event as the minimum if its lateness is negative."""
        self.late = min(max(0.0, self.late), self._most)
