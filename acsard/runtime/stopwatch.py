"""Takes the durations of `figures.py`: of a period, a step, a line and a feedback line."""

from __future__ import annotations

from acsard.runtime.figures import Figures, LastMinute
from acsard.values import Estimate, Measured, Outputs


class Stopwatch:
    """Measures what the control loop tells it of; decides nothing."""

    def __init__(self) -> None:
        self._figures = Figures()
        self._missed = LastMinute()

    def measured(self, now_ns: int) -> dict[str, Measured]:
        """Every figure by its name."""
        return self._figures.measured(now_ns)

    def missed(self, now_ns: int) -> int:
        """How many periods of the last minute had no step."""
        return self._missed.count(now_ns)

    def period(self, now_ns: int, late_ns: int, missed: int = 0) -> None:
        """A period's step began, so late, and so many before it had none."""
        self._figures.add("period_lateness", now_ns, late_ns)
        if missed:
            self._missed.add(now_ns, missed)

    def line(self, outputs: Outputs, sent_ns: int, before_ns: int) -> None:
        """A line left, after one at `before_ns`: how old is what it says?"""
        command_ns = outputs.command_ns
        if command_ns is None or outputs.mode != "driving":
            return
        self._figures.add("command_age", sent_ns, sent_ns - command_ns)
        if command_ns > before_ns:  # else it waited for its turn, not for the wire
            self._figures.add("command_to_wire", sent_ns, sent_ns - command_ns)

    def feedback(self, estimate: Estimate, told_ns: int | None) -> None:
        """A feedback line was folded, and told to the bus at `told_ns` if anybody listens."""
        at_ns, asked_ns = estimate.heard_ns, estimate.asked_ns
        if asked_ns is not None:
            self._figures.add("mcu_round_trip", at_ns, at_ns - asked_ns)
        if told_ns is not None:
            self._figures.add("feedback_to_bus", told_ns, told_ns - at_ns)

    def step(self, began_ns: int, ended_ns: int) -> None:
        """A step is over."""
        self._figures.add("step_time", began_ns, ended_ns - began_ns)
