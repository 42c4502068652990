"""The promises about a board that is unplugged and plugged in again, or that stays plugged in.

Times are in ns of the robot's monotonic clock, which stops while the host sleeps.
"""

from __future__ import annotations

from tests.simulate.product import Product, StepResult
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS

SEEN_NS = 20_000_000
"""The daemon knows within this time and a period that the board was unplugged."""

FIRST_LINE_NS = NS // 2
"""The first line leaves within this time after the board was plugged in."""


PERIODS = 2
"""Two lines are at most this number of periods apart: one may be lost to a torn line."""


class Plugging:
    """Judges the daemon's link state and lines when the board is unplugged or plugged in."""

    def __init__(self, witness: Witness) -> None:
        self._period_ns, self._line_pattern = witness.period_ns, witness.line_pattern
        self._judged_ns = -1
        """The plugging of which the first line was judged."""
        self._line_ns = -1
        """When the step ended that made the last line, or in which the link was not up."""

    def see(self, true_ns: int, snapshot: StepResult, product: Product, calm_ns: int) -> None:
        """Judge a step. The last stall of the host, or block of the output, ended at `calm_ns`."""
        if not product.plugged:
            late_ns = snapshot.decided_ns - product.unplugged_ns
            if snapshot.link == "up" and late_ns > SEEN_NS + self._period_ns:
                text = f"unplugged for {late_ns / NS:.3f} s, and the link is {snapshot.link}"
                raise BrokenError("an unplugged board is seen", true_ns, text)
            return
        plugged_ns = product.plugged_ns
        if snapshot.lines or snapshot.link != "up":
            self._line_ns = snapshot.at_ns
        else:
            late_ns = snapshot.decided_ns - max(self._line_ns, plugged_ns, calm_ns)
            if late_ns > PERIODS * self._period_ns + SEEN_NS:
                text = f"no line for {late_ns / NS:.3f} s"
                raise BrokenError("a linked board gets a line in each period", true_ns, text)
        if plugged_ns == self._judged_ns:
            return
        # A line of which the kernel took only a part is not judged here.
        for at_ns, line in snapshot.lines:
            if at_ns >= plugged_ns and line.endswith(b"\n"):
                self._judged_ns = plugged_ns
                match = self._line_pattern.match(line)
                if match is not None and any(float(speed[1:]) for speed in match.groups()):
                    text = f"{line!r} is the first line after the board was plugged in"
                    raise BrokenError("the first line is a zero", true_ns, text)
                return
        # The kernel may take only a part of the first lines.
        if snapshot.decided_ns - max(plugged_ns, calm_ns) > FIRST_LINE_NS + 3 * self._period_ns:
            text = f"plugged in at {plugged_ns / NS:.3f} s of its clock"
            raise BrokenError("a board that is plugged in gets a line", true_ns, text)
