"""Compares the wheels with each other, with their commands and with a gyro.

`wheels.py` ignores a wheel with a faulty encoder, and reports a wheel that does not obey its
command. `gyro.py` takes the heading from a gyro, and compares it with the wheels that are not
ignored. Only this module determines the order of these checks.
"""

from __future__ import annotations

from acsard.core.config.settings import FeedbackConfig, OdometryConfig
from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gyro import Gyro, Turn, claims
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.wheels import Wheels, count_angle, new_wheels
from acsard.core.values import Event, GyroSample, GyroStatus, Seconds, WheelsStatus

NO_ENCODERS = "feedback.encoders = false: the pose is what was commanded"


class ConsistencyChecks:
    """All consistency checks of one robot."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int,
        feedback: FeedbackConfig,
    ) -> None:
        self._kinematics = kinematics
        self._feedback, self._count = feedback, count_angle(encoder_counts)
        self.wheels: Wheels = new_wheels()
        self.gyro = Gyro() if odometry.gyro else None
        self._claims = claims(odometry, kinematics, encoder_counts)
        self.turn: Turn | None = None  # turn of the last line by the gyro; None: use the wheels
        self.slips = False  # the wheels contradict each other or the gyro
        self.events: tuple[Event, ...] = ()  # of the last line

    @property
    def wheels_status(self) -> WheelsStatus:
        return self.wheels.status if self._feedback.encoders else WheelsStatus(NO_ENCODERS)

    @property
    def gyro_status(self) -> GyroStatus:
        return GyroStatus() if self.gyro is None else self.gyro.status

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Store the samples since the last control step, in the order of arrival."""
        if self.gyro is not None:
            self.gyro.add_samples(samples)

    def forget_doubt(self) -> None:
        """Forget the uncertainty of the gyro's turns before now, because a new pose was set."""
        if self.gyro is not None:
            self.gyro.forget_doubt()

    def check_line(self, line: Feedback, rolled: Motors, seconds: Seconds, *, known: bool) -> None:
        """Check a line, and set `turn`, `slips` and `events`.

        The wheels `rolled` by these angles, rad, in `seconds` since the previous plausible line;
        `known` says that this is their whole motion.
        """
        wheels, gyro, turn, by_gyro = self.wheels, self.gyro, None, None
        if gyro is not None:
            way, by_wheels = self._kinematics.moved(wheels.believed(rolled))
            seconds_known, idle = seconds if known else 0.0, line.driven <= 0.0
            turn = gyro.turn(line.at.mono_ns, seconds_known, by_wheels, way, idle, self._claims)
            by_gyro = None if turn is None else turn.wheels
        self.turn = turn
        wheels.add(
            rolled, line.speeds, seconds, by_gyro, self._feedback, self._kinematics, self._count
        )
        self.slips = (
            wheels.slips
            or (turn is not None and turn.slips)
            or not self._feedback.encoders  # the speeds are commands
        )
        event = None if gyro is None else gyro.event()
        self.events = wheels.events if event is None else (event, *wheels.events)
