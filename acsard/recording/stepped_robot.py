"""Feeds recorded inputs to a robot: those of a step tell what became of the line before it."""

from __future__ import annotations

from acsard.core.robot import Robot
from acsard.core.values import Inputs, Ns, Outputs


class SteppedRobot:
    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._made_ns: Ns = 0
        self._line: bytes | None = None  # of the last step

    def step(self, inputs: Inputs) -> Outputs:
        """Report the last line as sent or superseded, and return the outputs of the next step."""
        if self._line is not None:
            line = None if inputs.superseded else self._line
            self.robot.sent(self._made_ns + inputs.late_ns, line, inputs.guard_trip)
        outputs = self.robot.step(inputs)
        self._made_ns, self._line = inputs.now.mono_ns, outputs.line
        return outputs
