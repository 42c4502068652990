"""Compares the wheels with each other, with their commands and with a gyro.

`wheels.py` ignores a wheel with a faulty encoder, and reports a wheel that does not obey its
command. `gyro.py` takes the heading from a gyro, and compares it with the wheels that are not
ignored. Only this module determines the order of these checks.
"""

from __future__ import annotations

from msgspec import Struct, field

from acsard.core.config.settings import FeedbackConfig, OdometryConfig
from acsard.core.link.feedback import Line
from acsard.core.motion.gyro import Gyro, Turn
from acsard.core.motion.uncertainty import ErrorModel
from acsard.core.motion.wheels import Wheels, new_wheels
from acsard.core.values import Event, GyroStatus, Seconds, Wheels4, WheelsStatus

NO_ENCODERS = "feedback.encoders = false: the pose is what was commanded"


class ConsistencyChecks(Struct):
    """All consistency checks of one robot."""

    wheels: Wheels
    gyro: Gyro = field(default_factory=Gyro)  # not used without `odometry.gyro`
    turn: Turn | None = None  # turn of the last line by the gyro; None: use the wheels
    slips: bool = False  # the wheels contradict each other or the gyro
    events: tuple[Event, ...] = ()  # of the last line

    @classmethod
    def initial(cls, model: ErrorModel) -> ConsistencyChecks:
        return cls(new_wheels(model.independent))

    def wheels_status(self, feedback: FeedbackConfig) -> WheelsStatus:
        return self.wheels.status if feedback.encoders else WheelsStatus(NO_ENCODERS)

    def gyro_status(self, odometry: OdometryConfig) -> GyroStatus:
        return self.gyro.status if odometry.gyro else GyroStatus()

    def check_line(
        self,
        model: ErrorModel,
        line: Line,
        rolled: Wheels4,
        seen: Wheels4,
        seconds: Seconds,
        *,
        known: bool,
    ) -> None:
        """Check a line, and set `turn`, `slips` and `events`.

        The wheels `rolled` by these angles, rad, in `seconds` since the previous plausible line;
        `known` says that this is their whole motion, and `seen` are those that judge the wheels.
        """
        wheels, gyro, turn, by_gyro, event = self.wheels, self.gyro, None, None, None
        if model.claims is not None:
            way, by_wheels = model.kinematics.moved(wheels.believed(rolled))
            seconds_known, idle = seconds if known else 0.0, line.driven <= 0.0
            turn = gyro.turn(line.at.mono_ns, seconds_known, by_wheels, way, idle, model.claims)
            by_gyro = None if turn is None else turn.trusted
            event = gyro.event()
        self.turn = turn
        feedback = model.feedback
        wheels.add(
            seen, line.speeds, seconds, by_gyro, feedback, model.kinematics, model.wheel_count
        )
        self.slips = wheels.slips or (turn is not None and turn.slips)
        self.events = wheels.events if event is None else (event, *wheels.events)
