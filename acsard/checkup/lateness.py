"""Measures the lateness of this computer, and decides which findings it spoils.

An overloaded computer sends and receives late, and so finds faults that the board does not have. If
the board is itself a program on this computer, the time for which it waits for a processor is
lateness as well. A step during which this computer was too late is repeated (`procedure.py`), and
its finding is never blamed on the board.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import Unsure

LEAST_S = 0.005
"""Smallest delay that is recorded, s. Every computer has smaller ones now and then."""

SPOILS_S = motion.PERIOD_S
"""Smallest delay of this computer that can cause a bad finding, s: a whole line was late."""

PAUSE_S = motion.WATCHDOG_LEAST_S
"""Smallest delay of this computer that makes even a good finding doubtful, s.

The watchdog may have cut the motors in that time.
"""


LATE = "late: not judged"
"""The outcome of a step for which this computer was too late."""


class Lateness:
    """The delays with which this computer woke up, and the times at which they ended, both in s."""

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
    """Return whether a computer that was late by up to `late_s` s may have caused the finding.

    The computer may have been late both at the start and at the end of a measurement, so half of
    the finding's margin is enough.
    """
    least_s = PAUSE_S if found.verdict == "PASS" else SPOILS_S
    return late_s >= max(least_s, found.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return the finding that the step `name` was not judged, because this computer was late."""
    return outcomes.find(LATE, name=name, late=late_s * 1000)


def judged(found: Finding) -> bool:
    """Return whether the finding says anything about the board."""
    return found.figure != outcomes.MANUAL[LATE].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the subjects whose last finding says that they were not judged."""
    last = {found.name: found for found in findings}
    return [name for name, found in last.items() if not judged(found)]
