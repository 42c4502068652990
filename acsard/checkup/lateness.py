"""Records when this computer ran the check too late, and decides which findings are then doubtful.

An overloaded computer sends and receives late. The check would then find faults that the board does
not have. `procedure.py` therefore repeats a step with a doubtful finding. If every attempt is
doubtful, the finding says that the step was not judged, and does not blame the board. The board can
also be a simulator on this computer. The time for which the simulator waits for a processor counts
as a delay of this computer too.
"""

from __future__ import annotations

from collections.abc import Iterable

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import Finding
from acsard.checkup.outcomes import TimingFinding

MIN_DELAY_S = 0.005
"""Shortest delay of this computer that `HostDelays` records, s. Shorter delays are normal."""

MAX_LATENESS_S = motion.LINE_PERIOD_S
"""Shortest delay of this computer that can make a finding doubtful, s. It is the time between two
lines of the check. For a finding with the verdict PASS, the limit is `MAX_PAUSE_S`."""

MAX_PAUSE_S = motion.MIN_WATCHDOG_S
"""Shortest delay of this computer that can make even a finding with the verdict PASS doubtful, s.

During such a delay the board's watchdog may have stopped the motors.
"""


NOT_JUDGED = "late: not judged"


class HostDelays:
    """Record of the delays of this computer: the times by which it ran the check too late."""

    def __init__(self) -> None:
        self._delays: list[tuple[float, float]] = []

    def record(self, late_s: float, now_s: float) -> None:
        """Record a delay of `late_s` s that ended at the monotonic time `now_s`, s.

        A delay that is shorter than `MIN_DELAY_S` is ignored.
        """
        if late_s >= MIN_DELAY_S:
            self._delays.append((now_s, late_s))

    def since(self, began_s: float) -> float:
        """Return the longest delay that ended at or after the monotonic time `began_s`, s.

        Return 0 if no such delay is recorded.
        """
        return max((late_s for at_s, late_s in self._delays if at_s >= began_s), default=0.0)


def is_doubtful(result: TimingFinding, late_s: float) -> bool:
    """Return whether the finding may be wrong because this computer ran the check too late.

    `late_s` is the longest delay of this computer during the step, s. The finding is doubtful if
    this delay reaches half of `result.margin_s`, the time by which the measurement exceeds its
    limit. The delay must also reach `MAX_PAUSE_S` for the verdict PASS, else `MAX_LATENESS_S`.
    """
    # Half of the margin is enough, because this computer may have been late by the same time at the
    # start and at the end of the measurement.
    least_s = MAX_PAUSE_S if result.verdict == "PASS" else MAX_LATENESS_S
    return late_s >= max(least_s, result.margin_s / 2)


def finding(name: str, late_s: float) -> Finding:
    """Return a finding which says that the step `name` is not judged because it ran too late.

    `late_s` is the longest delay of this computer during the step, s.
    """
    return outcomes.find(NOT_JUDGED, name=name, late=late_s * 1000)


def judged(result: Finding) -> bool:
    """Return False if the finding says that the step was not judged, otherwise True."""
    return result.figure != outcomes.OUTCOMES_BY_NAME[NOT_JUDGED].figure


def unjudged(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the steps that were not judged because this computer was too slow.

    If several findings have the same name, only the last one counts.
    """
    last = {result.name: result for result in findings}
    return [name for name, result in last.items() if not judged(result)]
