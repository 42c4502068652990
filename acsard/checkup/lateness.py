"""How late this computer was meanwhile, and what that leaves of a finding.

A computer with more to do than it can is late to ask and late to hear, and finds faults that the
board does not have. Where the board is a program of this computer, too, that one's wait counts as
well. What was found in such a time is looked at again (`procedure.py`), and never blamed on it.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import limits, manual
from acsard.checkup.findings import Finding
from acsard.checkup.manual import Unsure

LEAST_S = 0.005
"""What is not worth remembering: every computer is as late now and then."""

SPOILS_S = limits.PERIOD_S
"""From here on a fault may be this computer's: a whole line was late."""

PAUSE_S = limits.WATCHDOG_LEAST_S
"""From here on even what looks right may be, since the motors may have stopped meanwhile."""


LATE = "late: not judged"
"""The outcome of a step that this computer was too late for."""


class Lateness:
    """What was late, and when; times are s."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []

    def look(self, late_s: float, now_s: float) -> None:
        """Something was so late now."""
        if late_s >= LEAST_S:
            self._seen.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """The most since then."""
        return max((late_s for at_s, late_s in self._seen if at_s >= began_s), default=0.0)


def spoilt(found: Unsure, late_s: float) -> bool:
    """Whether so late a computer may have made this finding: it can have been so late twice in what
    was measured, where that began and where it ended."""
    least_s = PAUSE_S if found.verdict == "PASS" else SPOILS_S
    return late_s >= max(least_s, found.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Nothing is known of this step, whatever was seen."""
    return manual.find(LATE, name=name, late=late_s * 1000)


def judged(found: Finding) -> bool:
    """It says something of the board."""
    return found.figure != manual.MANUAL[LATE].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """The names that no finding says anything of; a later one may have."""
    last = {found.name: found for found in findings}
    return [name for name, found in last.items() if not judged(found)]
