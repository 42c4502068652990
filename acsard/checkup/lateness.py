"""Measures the lateness of this computer, and decides which findings it spoils.

An overloaded computer asks late and receives late, and so finds faults that the board does not
have. If the board is itself a program on this computer, its waiting time counts as well. A step
that ran at such a time is repeated (`procedure.py`), and its finding is never blamed on the board.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import Unsure

LEAST_S = 0.005
"""Lateness below which nothing is recorded, s: every computer has as much now and then."""

SPOILS_S = motion.PERIOD_S
"""Lateness from which on a fault may be this computer's, s: a whole line was late."""

PAUSE_S = motion.WATCHDOG_LEAST_S
"""Lateness, s, from which even a good result is doubtful: the watchdog may have cut motors."""


LATE = "late: not judged"
"""The outcome of a step for which this computer was too late."""


class Lateness:
    """Delays of this computer and their times, in s."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []

    def look(self, late_s: float, now_s: float) -> None:
        """Record a delay that ends now."""
        if late_s >= LEAST_S:
            self._seen.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """Return the largest delay that ended at `began_s` or later, s; 0 if there was none."""
        return max((late_s for at_s, late_s in self._seen if at_s >= began_s), default=0.0)


def spoilt(found: Unsure, late_s: float) -> bool:
    """Return whether a computer that was this late may have caused the finding.

    It may have been late twice within a measurement: where that began and where it ended.
    """
    least_s = PAUSE_S if found.verdict == "PASS" else SPOILS_S
    return late_s >= max(least_s, found.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return the finding that a step was not judged."""
    return outcomes.find(LATE, name=name, late=late_s * 1000)


def judged(found: Finding) -> bool:
    """Return whether the finding says anything about the board."""
    return found.figure != outcomes.MANUAL[LATE].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names that no finding judges. The last finding of each name counts."""
    last = {found.name: found for found in findings}
    return [name for name, found in last.items() if not judged(found)]
