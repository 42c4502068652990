"""Decides whether a step of the control loop is late, for all parts of the robot.

The daemon reads lines, reports and commands only in its steps. What comes with a late step may have
waited, so neither the board nor a sender is to blame for a silence that ends with one.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.link.link_setup import LinkSetup
from acsard.core.values import NS_PER_S, Ns, Seconds

# Between two steps: the second is late for commands and reports. The longest period is 100 ms. A
# line is missing earlier, by `LinkSetup.late_step_ns`.
LATE_NS = 150_000_000

CATCH_UP_NS = 100_000_000  # after a late step, what waited is still being read


class StepTimes(Struct):
    at_ns: Ns | None = None  # last step
    passed_ns: Ns = 0  # between the last two steps
    step_s: Seconds = 0.0  # the same, if lines may be missing for it
    late_s: Seconds = 0.0  # largest `step_s` since the last good line
    # For which a line may have waited that this step reads: the longest time between two steps,
    # less the period, until `CATCH_UP_NS` after it.
    waited_ns: Ns = 0
    catches_up_ns: Ns = 0

    def begin(self, setup: LinkSetup, now_ns: Ns) -> Ns | None:
        """Begin a step, and return when the one before began."""
        before_ns, self.at_ns = self.at_ns, now_ns
        passed_ns = self.passed_ns = 0 if before_ns is None else now_ns - before_ns
        self.step_s = passed_ns / NS_PER_S if passed_ns >= setup.late_step_ns else 0.0
        late_ns = max(0, passed_ns - setup.command_interval_ns)
        if late_ns >= self.waited_ns or now_ns > self.catches_up_ns:
            self.waited_ns, self.catches_up_ns = late_ns, now_ns + CATCH_UP_NS
        return before_ns

    @property
    def is_steady(self) -> bool:
        return not (self.step_s or self.is_late)

    @property
    def is_late(self) -> bool:
        return self.passed_ns > LATE_NS

    def end_silence(self, setup: LinkSetup, good: bool) -> bool:
        """Record whether a good line came; return whether it ends a silence of this computer.

        The built-in simulator runs on this computer, so with it the result is True for every good
        line.
        """
        late_s = max(self.late_s, self.step_s)
        self.late_s = 0.0 if good else late_s
        return good and (late_s > 0.0 or setup.mcu.simulated)
