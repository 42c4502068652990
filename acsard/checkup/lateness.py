"""Measures the lateness of this computer, and decides which findings may be wrong because of it.

An overloaded computer sends and receives late, and so finds faults that the board does not have. If
the board is a program on this computer, its waits for a processor count as lateness too. A step
during which this computer was late is repeated (`procedure.py`). If it is late each time, the
finding says so and does not blame the board.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import Unsure

LEAST_S = 0.005
"""Smallest delay that is recorded, s. Every computer has smaller ones now and then."""

SPOILS_S = motion.PERIOD_S
"""Smallest delay of this computer that can cause a bad finding, s: the time between two lines."""

PAUSE_S = motion.WATCHDOG_LEAST_S
"""Smallest delay of this computer that makes even a good finding doubtful, s. The board's watchdog
may have stopped the motors in that time."""


LATE = "late: not judged"


class Lateness:
    """Record of the delays with which this computer woke up from waiting."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []

    def look(self, late_s: float, now_s: float) -> None:
        """Record a delay of `late_s` that ends at the monotonic time `now_s`, both in s."""
        if late_s >= LEAST_S:
            self._seen.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """Return the largest delay that ended at `began_s` or later, s; 0 if there was none."""
        return max((late_s for at_s, late_s in self._seen if at_s >= began_s), default=0.0)


def spoilt(found: Unsure, late_s: float) -> bool:
    """Return whether the finding may be wrong because this computer was late by up to `late_s` s.

    A delay of half of `found.margin_s` is enough, because the computer may have been late both at
    the start and at the end of the measurement.
    """
    least_s = PAUSE_S if found.verdict == "PASS" else SPOILS_S
    return late_s >= max(least_s, found.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return the finding that the step `name` was not judged because this computer was late."""
    return outcomes.find(LATE, name=name, late=late_s * 1000)


def judged(found: Finding) -> bool:
    """Return False if the finding says only that this computer was too late to judge the step."""
    return found.figure != outcomes.MANUAL[LATE].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the steps that were not judged, according to their last findings."""
    last = {found.name: found for found in findings}
    return [name for name, found in last.items() if not judged(found)]
