"""Compares the wheels with each other, with their commands and with a gyro.

`ConsistencyChecks` is the only interface to these checks. It uses two modules:

- `wheel_faults.py` ignores a wheel whose encoder is faulty. If the wheels contradict each other or
  their commands for long, it reports a fault, which stops the robot.
- `gyro.py` takes the heading from a gyro, and compares the gyro with the wheels that
  `wheel_faults.py` does not ignore.

Some checks use the results of others. Only this module determines their order.
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
    """All consistency checks of one robot.

    For each feedback line, the odometry calls `check_line`, updates the pose, and calls `finish`.
    """

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int,
        feedback: FeedbackConfig,
    ) -> None:
        """Start with no faulty wheel, and with an unproven gyro if the robot has one.

        `encoder_counts` is the number of counts per revolution of a wheel; 0 if it is unknown.
        """
        self._kinematics = kinematics
        self.wheels = WheelFaults(kinematics, encoder_counts, feedback)
        self.gyro = Gyro() if odometry.gyro else None
        self._by_wheels = 0.0
        """Turn of the robot in the last feedback line according to the wheels, rad."""
        self.turn: Turn | None = None
        """Turn of the robot in the last feedback line according to the gyro. If it is None, the
        odometry must use the turn according to the wheels."""
        self.on_trial = False
        """Whether the wheels provided the turn of the last line because the gyro was not proven. A
        gyro is proven when it has agreed with the wheels in a turn."""
        self.slips = False
        """Whether the wheels slip, which means that they contradict each other or the gyro."""
        self.events: list[Event] = []
        """Log events of the last feedback line."""

    @property
    def gyro_status(self) -> GyroStatus:
        return GyroStatus() if self.gyro is None else self.gyro.status

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Store the gyro `samples` since the last control step, in the order of arrival."""
        if self.gyro is not None:
            self.gyro.add_samples(samples)

    def drop_corrections(self) -> None:
        """Drop the pending correction of the heading by the gyro, because a new pose was set."""
        if self.gyro is not None:
            self.gyro.drop_corrections()

    def check_line(self, line: Feedback, rolled: Rolled) -> bool:
        """Check a feedback line, and return whether it has proved a wheel faulty.

        If it has, the caller must recompute the pose from the earlier lines without this wheel.
        `rolled` contains the angles that the wheels rolled since the previous plausible feedback
        line.
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
        """Return the angle that the caller must subtract from the heading, rad.

        Call this after a faulty wheel was found, and the pose was recomputed without it over
        earlier feedback lines. `turn` is the change of the robot's turn by this recomputation, rad.
        Only the lines with `on_trial` count, in which the gyro was not proven.

        If the gyro is proven by now, the heading already agrees with the gyro. The caller must then
        undo the change, so the result is `turn`. Otherwise the result is 0. If the test of the gyro
        goes on, the method changes the pending correction of the heading by -`turn`.
        """
        return 0.0 if self.gyro is None else self.gyro.undo_recomputation(turn)

    def finish(self, turned: float) -> None:
        """Finish the checks of the last feedback line, and set `events` to its log events.

        `turned` is the angle by which this line turned the pose, rad.
        """
        gyro, self.events = self.gyro, self.wheels.events
        if gyro is None:
            return
        if self.on_trial and turned != self._by_wheels:
            gyro.undo_recomputation(turned - self._by_wheels)
        if gyro.events:
            self.events = gyro.events + self.events
