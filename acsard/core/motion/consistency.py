"""Compares the wheels with each other, with their commands and with a gyro.

`wheel_faults.py` ignores a wheel with a faulty encoder, and reports a fault after a long
contradiction. `gyro.py` takes the heading from a gyro, and compares it with the wheels that are not
ignored. Only this module determines the order of these checks.
"""

from __future__ import annotations

from acsard.core.config.settings import FeedbackConfig, OdometryConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gap_filling import AT_REST, Rolled, plus
from acsard.core.motion.gyro import Gyro, Turn
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.wheel_faults import WheelFaults
from acsard.core.values import Event, GyroSample, GyroStatus


class ConsistencyChecks:
    """All consistency checks of one robot: `check_line`, then the pose, then `finish`."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int,
        feedback: FeedbackConfig,
    ) -> None:
        self._kinematics = kinematics
        self.wheels = WheelFaults(kinematics, encoder_counts, feedback)
        self.gyro = Gyro() if odometry.gyro else None
        self._by_wheels = 0.0  # turn of the last line by the wheels, rad
        self.turn: Turn | None = None  # turn of the last line by the gyro; None: use the wheels
        self.on_trial = False  # the wheels gave the turn: the gyro has not agreed with them yet
        self.slips = False  # the wheels contradict each other or the gyro
        self.events: list[Event] = []  # of the last line

    @property
    def gyro_status(self) -> GyroStatus:
        return GyroStatus() if self.gyro is None else self.gyro.status

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Store the samples since the last control step, in the order of arrival."""
        if self.gyro is not None:
            self.gyro.add_samples(samples)

    def drop_corrections(self) -> None:
        """Drop the gyro's pending correction of the heading, because a new pose was set."""
        if self.gyro is not None:
            self.gyro.drop_corrections()

    def check_line(self, line: Feedback, rolled: Rolled) -> bool:
        """Check a line, and return whether it has proved a wheel faulty.

        The caller must then recompute the pose from the earlier lines without this wheel.
        """
        wheels, gyro, turn, by_gyro = self.wheels, self.gyro, None, None
        if gyro is not None:
            turned = rolled.turned
            for piece in rolled.pieces:
                turned = plus(turned, piece)
            self._by_wheels = self._kinematics.moved(wheels.believed(turned))[1]
            still = wheels.believed(line.speeds.as_tuple()) == AT_REST
            turn = gyro.turn(line.at.mono_ns, rolled.known, self._by_wheels, still)
            self.on_trial = gyro.owes
            by_gyro = None if turn is None else turn.wheels
        self.turn = turn
        is_faulty = wheels.check_line(rolled.seen, line.speeds, rolled.seconds, by_gyro)
        self.slips = wheels.slips or (turn is not None and turn.slips)
        return is_faulty

    def undo_recomputation(self, turn: float) -> float:
        """Return the angle to subtract from the heading after a wheel proved faulty.

        See `Gyro.undo_recomputation`; `turn` is for lines with `on_trial`, rad.
        """
        return 0.0 if self.gyro is None else self.gyro.undo_recomputation(turn)

    def finish(self, turned: float) -> None:
        """Finish the checks of a line that turned the pose by `turned`, and set `events`."""
        gyro, self.events = self.gyro, self.wheels.events
        if gyro is None:
            return
        if self.on_trial and turned != self._by_wheels:
            gyro.undo_recomputation(turned - self._by_wheels)
        if gyro.events:
            self.events = gyro.events + self.events
