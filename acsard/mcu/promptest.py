"""How late a thing comes, by two clocks that were never compared: against the promptest so far.

Arrival by our clock less departure by theirs holds the delay and how far the clocks are apart.
That nobody knows, but how much longer than the shortest delay this one is, it tells. Clocks drift:
the promptest counts for less as time goes by.
"""

from __future__ import annotations

import math


class Promptest:
    """Remembers how late the last one came; in one unit of time, the caller's."""

    def __init__(self, drift: float, most: float = math.inf) -> None:
        """By which share the clocks may go apart; what is later than `most` counts as that late."""
        self._drift, self._most = drift, most
        self.late = 0.0
        """How much later than the promptest the last one came."""

    def add(self, ours: float, theirs: float) -> float:
        """One more, so long after the last by our clock and by theirs; drift is forgiven after it.

        How much later than the promptest so far: below 0 it is the promptest now.
        """
        later = self.late + ours - theirs
        self.measure(ours, theirs)
        self.believe()
        return later

    def measure(self, ours: float, theirs: float) -> float:
        """`late` of one more, drift forgiven; below 0, it is prompter than whom we believe."""
        self.late = self.late + ours - theirs - self._drift * ours
        return self.late

    def believe(self) -> None:
        """The last one measured is the promptest, if none was prompter."""
        self.late = min(max(0.0, self.late), self._most)
