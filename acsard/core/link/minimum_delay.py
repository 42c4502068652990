"""Measures the delay of events between two unrelated clocks, relative to the least delay so far.

Arrival by our clock minus departure by the other is the delay plus an unknown offset. The least
difference so far cancels it. The clocks drift, so this minimum slowly rises as time passes.
"""

from __future__ import annotations

import math

MAX_DRIFT = 0.01  # relative; a ceramic resonator reaches half of it


class MinimumDelay:
    """The delay of the last event minus the least so far, in the caller's unit of time."""

    def __init__(self, drift: float = MAX_DRIFT, most: float = math.inf) -> None:
        # A larger excess than `most` raises the least delay.
        self._drift, self._most = drift, most
        self.late = 0.0

    def add(self, ours: float, theirs: float) -> float:
        """Return an event's delay minus the least so far; a negative one is the new least.

        `ours` and `theirs` are the times since the previous event by the two clocks.
        """
        later = self.late + ours - theirs
        self.measure(ours, theirs)
        self.believe()
        return later

    def measure(self, ours: float, theirs: float) -> float:
        """Return an event's delay minus the least delay and the allowed drift since the last event.

        The least delay changes only by `believe`.
        """
        self.late = self.late + ours - theirs - self._drift * ours
        return self.late

    def believe(self) -> None:
        self.late = min(max(0.0, self.late), self._most)
