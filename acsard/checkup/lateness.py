"""Records when this computer ran the check too late, and decides which findings are doubtful.

An overloaded computer would find faults that the board does not have. `procedure.py` repeats a step
with a doubtful finding; if every attempt is doubtful, the step counts as not judged. The time for
which a simulated board waits for a processor counts as a delay of this computer too.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import TimingFinding
from acsard.core.tables.finding_table import code_of

# Shortest delay of this computer that `HostDelays` records. Shorter delays are normal.
MIN_DELAY_S = 0.005

# Shortest delay of this computer that can make a finding doubtful. It is the time between two lines
# of the check. For a finding with the verdict PASS, the limit is `MAX_PAUSE_S`.
MAX_LATENESS_S = motion.LINE_PERIOD_S

# In such a delay the board's watchdog may have stopped the motors.
MAX_PAUSE_S = motion.MIN_WATCHDOG_S


NOT_JUDGED: outcomes.Outcome = "late: not judged"


class HostDelays:
    """Record of the delays of this computer: the times by which it ran the check too late."""

    def __init__(self) -> None:
        self._delays: list[tuple[float, float]] = []

    def record(self, late_s: float, now_s: float) -> None:
        """Record a delay that ended at the monotonic time `now_s`, unless below `MIN_DELAY_S`."""
        if late_s >= MIN_DELAY_S:
            self._delays.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """Return the longest delay that ended at or after the monotonic time `began_s`, s, or 0."""
        return max((late_s for at_s, late_s in self._delays if at_s >= began_s), default=0.0)


def is_doubtful(result: TimingFinding, late_s: float) -> bool:
    """Return whether a delay of `late_s` s during the step may have caused the finding.

    It must reach half of `result.margin_s`, and `MAX_PAUSE_S` for the verdict PASS, else
    `MAX_LATENESS_S`.
    """
    # Half of the margin is enough, because this computer may have been late by the same time at the
    # start and at the end of the measurement.
    least_s = MAX_PAUSE_S if result.verdict == "PASS" else MAX_LATENESS_S
    return late_s >= max(least_s, result.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return a finding which says that the step `name` is not judged because it ran too late."""
    return outcomes.find(NOT_JUDGED, name=name, late=late_s * 1000)


def judged(result: Finding) -> bool:
    """Return False if the finding says that the step was not judged, otherwise True."""
    return result.code != code_of(NOT_JUDGED)


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the steps whose last finding says that they were not judged."""
    last = {result.name: result for result in findings}
    return [name for name, result in last.items() if not judged(result)]
