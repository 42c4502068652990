"""Reads the values that a report needs from the replayed robot, an object of the class `Robot`.

A forged state may make any part wrong, so only this module reads it, in blocks that make an
exception an error of the recording, and each value that leaves has its type. An exception elsewhere
is a defect of the report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext

import msgspec

from acsard.core.motion.arbiter_text import OBJECTIONS
from acsard.core.robot import Robot
from acsard.core.values import Ns, Outputs, SourceStatus

# Raises `RecordingError` for the errors of a wrong recorded state.
RobotErrors = Callable[[], AbstractContextManager[None]]


class RobotReader:
    """Reads and checks the values of the robot that has just replayed a step."""

    def __init__(self, errors: RobotErrors = nullcontext) -> None:
        self._errors = errors

    def check(self, outputs: Outputs) -> None:
        """Check that all speeds in the outputs are numbers (inf and NaN too); a forger may lie."""
        with self._errors():
            for speeds, twist in (
                (outputs.speeds, outputs.applied),
                *((estimate.speeds, estimate.twist) for estimate in outputs.estimates),
            ):
                for number in (*speeds.as_tuple(), twist.linear, twist.angular):
                    math.isfinite(number)  # raises TypeError for anything but a number

    def lines(self, robot: Robot) -> Mapping[str, int]:
        """Return the counters of lines: readable ones, and each `line_...` of dropped ones."""
        with self._errors():
            session = robot.session
            return msgspec.convert(
                {
                    "lines": session.good_lines,
                    **{f"line_{reason}": count for reason, count in session.rejects.items()},
                    "line_implausible": robot.counters["line_implausible"],
                },
                dict[str, int],
            )

    def refused(self, robot: Robot) -> Mapping[str, int]:
        """Return how many commands were refused, for each reason in `OBJECTIONS`."""
        with self._errors():
            return msgspec.convert(
                {name: robot.counters[f"command_{name}"] for name in OBJECTIONS}, dict[str, int]
            )

    def sources(self, robot: Robot, now_ns: Ns) -> tuple[SourceStatus, ...]:
        """Return the state of each command source at the monotonic time `now_ns`, ns."""
        with self._errors():
            sources = msgspec.to_builtins(robot.snapshot(now_ns).sources)
            return msgspec.convert(sources, tuple[SourceStatus, ...])
