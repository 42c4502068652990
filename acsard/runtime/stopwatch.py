"""Measures the durations of `figures.py`: of periods, steps, lines and feedback."""

from __future__ import annotations

from acsard.runtime.figures import Figures, LastMinute
from acsard.values import Estimate, Measured, Outputs


class Stopwatch:
    """The measurements of the control loop."""

    def __init__(self) -> None:
        self._figures = Figures()
        self._missed = LastMinute()

    def measured(self, now_ns: int) -> dict[str, Measured]:
        """Return all figures by name."""
        return self._figures.measured(now_ns)

    def missed(self, now_ns: int) -> int:
        """Return the number of periods in the last minute that had no step."""
        return self._missed.count(now_ns)

    def period(self, now_ns: int, late_ns: int, missed: int = 0) -> None:
        """Record the start of a period's step, `late_ns` late.

        `missed` periods before it had no step.
        """
        self._figures.add("period_lateness", now_ns, late_ns)
        if missed:
            self._missed.add(now_ns, missed)

    def line(self, outputs: Outputs, sent_ns: int, before_ns: int) -> None:
        """Record a line that left, after one at `before_ns`, by the age of its command."""
        command_ns = outputs.command_ns
        if command_ns is None or outputs.mode != "driving":
            return
        self._figures.add("command_age", sent_ns, sent_ns - command_ns)
        if command_ns > before_ns:  # otherwise it waited for its source's turn, not for the wire
            self._figures.add("command_to_wire", sent_ns, sent_ns - command_ns)

    def feedback(self, estimate: Estimate, told_ns: int | None) -> None:
        """Record a feedback line.

        `told_ns` is when its messages were queued, None if nobody listens.
        """
        at_ns, asked_ns = estimate.heard_ns, estimate.asked_ns
        if asked_ns is not None:
            self._figures.add("mcu_round_trip", at_ns, at_ns - asked_ns)
        if told_ns is not None:
            self._figures.add("feedback_to_bus", told_ns, told_ns - at_ns)

    def step(self, began_ns: int, ended_ns: int) -> None:
        """Record the start and the end of a step."""
        self._figures.add("step_time", began_ns, ended_ns - began_ns)
