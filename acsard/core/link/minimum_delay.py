"""Measures the delay of events between two unrelated clocks, relative to the least delay so far.

The arrival time by this computer's clock minus the departure time by the other clock is the delay
plus an unknown offset between the clocks. The smallest such difference so far belongs to the event
with the least delay. Subtracting the smallest difference cancels the offset, so the result is the
delay in excess of the minimum. The clocks drift, so the stored minimum slowly rises as time passes.
"""

from __future__ import annotations

import math

MAX_DRIFT = 0.01
"""Largest relative drift between two clocks. A ceramic resonator reaches half of it."""


class MinimumDelay:
    """The delay of the last event minus the least delay so far, in the caller's unit of time."""

    def __init__(self, drift: float = MAX_DRIFT, most: float = math.inf) -> None:
        """Start before the first event.

        `drift` is the largest relative drift between the two clocks. `most` limits the excess of a
        delay over the least delay, in the caller's unit of time. If the delay of an event exceeds
        the least delay by more than `most`, the least delay rises until the excess is `most`.
        """
        self._drift, self._most = drift, most
        self.late = 0.0

    def add(self, ours: float, theirs: float) -> float:
        """Process an event, and return its delay minus the least delay so far.

        If the result is negative, this event sets a new least delay. `ours` is the time since the
        previous event by this computer's clock, and `theirs` is the same time by the other clock.
        Unlike `measure`, this method does not subtract the allowed drift since the previous event.
        """
        later = self.late + ours - theirs
        self.measure(ours, theirs)
        self.believe()
        return later

    def measure(self, ours: float, theirs: float) -> float:
        """Return the delay of an event, minus the least delay and minus the allowed drift.

        The least delay does not change until `believe` is called. `ours` is the time since the
        previous event by this computer's clock, and `theirs` is the same time by the other clock.
        """
        self.late = self.late + ours - theirs - self._drift * ours
        return self.late

    def believe(self) -> None:
        """Accept the last measured event as true, and update the least delay.

        The least delay falls to the delay of this event if that delay is smaller. It rises if the
        delay of this event exceeds it by more than `most`.
        """
        self.late = min(max(0.0, self.late), self._most)
