"""Measures the lateness of this computer, and decides which findings may be wrong because of it.

An overloaded computer sends and receives late, so that the check finds faults which the board does
not have. If the board is a program on this computer, the time for which this program waits for a
processor counts as lateness too. If this computer was late during a step, the step is repeated
(`procedure.py`). If this computer is late each time, the finding says so and does not blame the
board.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import Unsure

LEAST_S = 0.005
"""Smallest delay that is recorded, s. Every computer has smaller delays now and then."""

SPOILS_S = motion.PERIOD_S
"""Smallest delay of this computer that can cause a bad finding, s: the time between two lines."""

PAUSE_S = motion.WATCHDOG_LEAST_S
"""Smallest delay of this computer that makes even a good finding doubtful, s. During such a delay
the board's watchdog may have stopped the motors."""


LATE = "late: not judged"


class Lateness:
    """Record of delays: how much too late this computer woke up from each wait."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []

    def look(self, late_s: float, now_s: float) -> None:
        """Record a delay of `late_s` s that ended at the monotonic time `now_s`, s.

        Delays that are shorter than `LEAST_S` are ignored.
        """
        if late_s >= LEAST_S:
            self._seen.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """Return the largest delay that ended at `began_s` or later, s; 0 if there was none."""
        return max((late_s for at_s, late_s in self._seen if at_s >= began_s), default=0.0)


def spoilt(found: Unsure, late_s: float) -> bool:
    """Return whether the finding may be wrong because this computer was late.

    `late_s` is the largest delay of this computer during the step, s. The finding may be wrong if
    this delay is at least half of `found.margin_s`, because this computer may have been late both
    at the start and at the end of the measurement. Delays below `PAUSE_S` do not spoil a finding
    with the verdict PASS, and delays below `SPOILS_S` do not spoil any other finding.
    """
    least_s = PAUSE_S if found.verdict == "PASS" else SPOILS_S
    return late_s >= max(least_s, found.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return the finding that the step `name` was not judged because this computer was late."""
    return outcomes.find(LATE, name=name, late=late_s * 1000)


def judged(found: Finding) -> bool:
    """Return False if the finding says that this computer was too late to judge the step."""
    return found.figure != outcomes.MANUAL[LATE].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the steps whose last finding says that they were not judged."""
    last = {found.name: found for found in findings}
    return [name for name, found in last.items() if not judged(found)]
