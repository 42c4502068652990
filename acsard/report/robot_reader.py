"""Reads the values that a report needs from the replayed robot, an object of the class `Robot`.

The robot may come from a forged or damaged recorded state, so each of its parts may be wrong. Only
this module reads the robot, in `with` blocks that report an exception as an error of the recording.
Each value that leaves the module has the declared type. Therefore an exception in the rest of the
report is a defect of the report, and not an error of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext

import msgspec

from acsard.core.motion.arbiter_text import OBJECTIONS
from acsard.core.robot import Robot
from acsard.core.values import Outputs, SourceStatus

RobotErrors = Callable[[], AbstractContextManager[None]]
"""Function that returns a context manager, which raises `RecordingError` instead of the errors that
a wrong recorded state of the robot causes."""


class RobotReader:
    """Reads and checks the values of the robot that has just replayed a step."""

    def __init__(self, errors: RobotErrors = nullcontext) -> None:
        self._errors = errors

    def check(self, outputs: Outputs) -> None:
        """Check that all speeds in the outputs have a numeric type.

        A forged recording may contain other types. Infinite speeds and NaN are permitted.
        """
        with self._errors():
            for speeds, twist in (
                (outputs.speeds, outputs.applied),
                *((estimate.speeds, estimate.twist) for estimate in outputs.estimates),
            ):
                for number in (*speeds.as_tuple(), twist.linear, twist.angular):
                    math.isfinite(number)  # raises TypeError for anything but a number

    def lines(self, robot: Robot) -> Mapping[str, int]:
        """Return the robot's counters of lines from the board.

        `lines` counts the readable lines, and each `line_...` counts the lines that were dropped
        for one reason.
        """
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
        """Return how many commands the robot has refused for each reason in `OBJECTIONS`."""
        with self._errors():
            return msgspec.convert(
                {name: robot.counters[f"command_{name}"] for name in OBJECTIONS}, dict[str, int]
            )

    def sources(self, robot: Robot, now_ns: int) -> tuple[SourceStatus, ...]:
        """Return the state of each command source at the monotonic time `now_ns`, ns."""
        with self._errors():
            sources = msgspec.to_builtins(robot.snapshot(now_ns).sources)
            return msgspec.convert(sources, tuple[SourceStatus, ...])
