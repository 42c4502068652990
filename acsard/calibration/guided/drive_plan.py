"""The types of a guided drive: `Method`, `Leg`, `Move` and measurements, and the robot's `Setup`.

`acsard calibrate` and the web page import this module for the names of the methods. It does not
import numpy, so that both programs start quickly.

A guided drive stays within the robot's limits and on a floor of 3 m x 3 m. Before the calibration,
the turn that a command causes is unknown, because the robot may skid. The plan must therefore work
for an effective track of 1 to 2.5 times the wheel separation. Each drive has one of these forms:

- It goes out and comes back on the same path.
- It is straight, and a person placed the robot in the right direction.
- It comes after a turn that a person measured, which shows the effective track.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config, DriveConfig, FeedbackConfig, OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import AcsardError, Twist
from acsard.terminal.prompt import NumberQuestion

NEEDS: dict[str, str] = {
    "gyro": "a gyro on the Zenoh key imu, and a tape measure",
    "positions": "positions of the robot on a Zenoh key",
    "tape": "a tape measure and a straight line on the floor",
}
"""Equipment that the person needs for each method, by the name of the method in `--method`."""


class GuideError(AcsardError):
    """The guided drive cannot continue. The text says why and what to do. No file was changed."""


class DisturbedError(GuideError):
    """A part of the guided drive was cut short for a temporary reason, and can be repeated."""

    def __init__(self, why: str, text: str) -> None:
        """Store the reason `why`, and the message `text` to show if this part is not repeated."""
        super().__init__(text)
        self.why = why


class Move(Struct, frozen=True):
    """A twist, and the time for which the tool commands it.

    A move with a zero twist is a pause.
    """

    seconds: float
    linear: float = 0.0
    """Linear speed, m/s."""
    angular: float = 0.0
    """Commanded turn rate, rad/s, positive to the left."""


UNITS = {"m": 1.0, "mm": 1e-3}
"""Factors that convert the units of the person's answers to m."""


Quantity = Literal["turned", "angle", "distance"]
"""Kind of a measurement of the robot's motion since its pose was last known.

- `turned`: the turn in rad, positive to the left, including whole turns.
- `angle`: the turn in rad, positive to the left, with an unknown number of whole turns.
- `distance`: the straight-line distance in m.
"""


class Distance(Struct, frozen=True):
    """A straight-line distance of the leg just driven, which a person measures by tape."""

    answer: str
    """Name of the answer."""
    deviation: float
    """Standard deviation of the answer, m."""


class Slant(Struct, frozen=True):
    """A measurement of the robot's turn by the distances of two points of the robot to a line.

    The person measures the distances. The line is on the floor.
    """

    quantity: Literal["turned", "angle"]
    near: str
    """Name of the answer with the distance of one point of the robot from the line.

    A turn to the left moves this point towards the line.
    """
    far: str
    """Name of the answer with the distance of the other point of the robot from the line.

    A turn to the left moves this point away from the line.
    """
    apart: str
    """Name of the answer with the distance between the two points of the robot.

    The tool asks for this distance once, before the first leg.
    """
    since: str = ""
    """Name of the earlier leg after which the person measured the robot's start angle to the line.

    "" means that the robot started parallel to the line.
    """
    plus: float = 0.0
    """Whole turns to add, rad, because the distances to the line do not show them."""
    over: tuple[str, ...] = ()
    """Names of the legs whose total motion the person measured; () means the leg just driven."""


Measure = Distance | Slant


class Leg(Struct, frozen=True):
    """A series of moves that a person starts with Enter and can stop at any time with any key."""

    name: str
    words: str
    """Text that tells the person, before the leg, what to do and how the robot will move."""
    moves: tuple[Move, ...]
    asks: tuple[NumberQuestion, ...] = ()
    """Questions that the person answers after the moves."""
    measures: tuple[Measure, ...] = ()
    by_key: bool = False
    """Whether the person ends the last move with a key.

    The duration of this move is then a timeout.
    """

    @property
    def seconds(self) -> float:
        return sum(move.seconds for move in self.moves)


FLOOR_M = 3.0
"""Side length of the square floor that must be free, m."""

USUAL_SPEED = 0.3
"""Speed straight ahead in a guided drive, m/s, unless the robot's limits are lower."""

MAX_ROLLING_SPEED = 0.5
"""Largest rolling speed of the wheels while the robot turns in a guided drive, m/s."""

REACH_RATIO = 0.75
"""Assumed distance from the robot's middle to its outermost point, as a multiple of the wheel
separation."""

EDGE_MARGIN_M = 0.1
"""Distance to keep between the robot and the edge of the floor, m."""

LONGEST, SHORTEST = 2.0, 0.8
"""Largest and smallest length of the straight drive, m."""

LEAST_SPEED, LEAST_TURN = 0.05, 0.2
"""Smallest limits with which a guided drive is possible.

`LEAST_SPEED` applies to the speed straight ahead, m/s, and `LEAST_TURN` to `limits.angular_speed`,
rad/s.
"""

STOP_DISTANCE_M = 0.1
"""Distance that the robot may still roll after a leg has ended, m."""

MAX_TRACK_RATIO = 2.5
"""Largest ratio of effective track to wheel separation for which the plan works.

The smallest ratio is 1.
"""


class Setup(Struct, frozen=True):
    """The robot, and the speeds and lengths of its guided drive."""

    drive: DriveConfig
    speed: float
    """Speed straight ahead, m/s."""
    length: float
    """Length of the straight drive, m."""
    reach: float
    """Distance from the robot's middle to its outermost point, m."""
    max_command_rate: float
    """Largest turn rate that the robot's limits permit in a command, rad/s."""
    max_rolling_speed: float
    """Largest rolling speed of the wheels while the robot turns, m/s."""
    odometry: OdometryConfig = OdometryConfig()
    feedback: FeedbackConfig = FeedbackConfig()

    @property
    def from_edge(self) -> float:
        """Distance from the robot's middle to the edge of the free floor behind the robot, m.

        A person places the robot at this distance from the edge before the straight drive begins.
        """
        return self.reach + EDGE_MARGIN_M

    @property
    def to_middle(self) -> float:
        """Distance from the end of the straight drive to the middle of the free floor, m.

        The robot drives back by this distance, so that it can turn in the middle of the floor.
        """
        return self.from_edge + self.length - FLOOR_M / 2

    def ahead(self, metres: float) -> Move:
        """Return a straight move of `metres` m. A negative distance is a move backwards."""
        return Move(abs(metres) / self.speed, math.copysign(self.speed, metres))

    def spin(self, rate: float, seconds: float) -> Move:
        """Return a turn in place that lasts `seconds` s.

        `rate` is the turn rate of a robot that does not skid, rad/s, positive to the left. A robot
        that skids turns more slowly.
        """
        return Move(seconds, 0.0, self.command(rate))

    def arc(self, rate: float, metres: float) -> Move:
        """Return a curve of the length `metres`, m. A negative length is a curve backwards.

        `rate` is the turn rate, rad/s, of a robot that does not skid, positive to the left.
        """
        straight = self.ahead(metres)
        return Move(straight.seconds, straight.linear, self.command(rate))

    def turn(self, angle: float, rate: float, track: float) -> Move:
        """Return a turn in place by `angle`, with a command that compensates for skidding.

        Args:
            angle: the angle of the turn, rad, positive to the left.
            rate: the true turn rate, rad/s. If the limits do not permit it, the robot turns more
                slowly.
            track: the ratio of effective track to wheel separation.
        """
        command = abs(self.command(rate * track))
        seconds = abs(angle) * track / (command * self.rate_per_command)
        return Move(seconds, 0.0, math.copysign(command, angle))

    def command(self, rate: float) -> float:
        """Return the turn rate to command, rad/s, for a true turn rate of `rate`, rad/s.

        The robot turns at `rate` if it does not skid. If the command would exceed the robot's
        limits, the result is the largest command within these limits.
        """
        per_command = self.rate_per_command
        most = min(
            2 * self.max_rolling_speed / self.drive.wheel_separation,
            self.max_command_rate * per_command,
        )
        return max(-most, min(most, rate)) / per_command

    @property
    def rate_per_command(self) -> float:
        """Turn rate of a robot that does not skid, rad/s, if the command is 1 rad/s.

        The rate differs from 1 because the configured multipliers compensate for skidding.
        """
        bare = replace(
            self.drive, wheel_separation_multiplier=1.0, left_wheel_radius_multiplier=1.0,
            right_wheel_radius_multiplier=1.0,
        )  # fmt: skip
        commanded = Kinematics(self.drive).wheel_speeds(Twist(0.0, 1.0))
        return Kinematics(bare).twist(commanded).angular


Legs = Callable[[Setup, float], tuple[Leg, ...]]
"""Function that returns the legs of a method.

Its arguments are the robot's setup, and the ratio of effective track to wheel separation. The
first `turned` measurement shows this ratio. The legs up to that measurement must not depend on the
ratio.
"""

# The largest ratio does not always need the longest time, because with a smaller ratio a leg may
# have one more full turn.
TRACK_RATIOS = [1.0 + 0.05 * step for step in range(round((MAX_TRACK_RATIO - 1.0) / 0.05) + 1)]
"""Ratios of effective track to wheel separation for which the driving time is computed."""


class Method(Struct, frozen=True):
    """A method of calibration by a guided drive."""

    legs: Legs
    asks: tuple[NumberQuestion, ...] = ()
    """Questions that the person answers before the first leg."""
    by_tape: bool = False
    """Whether a person measures the motion by tape; otherwise a sensor measures it."""

    def longest_s(self, setup: Setup) -> float:
        """Return the total driving time of all legs, s, for the least favorable effective track.

        The time depends on the ratio of effective track to wheel separation. The result is the
        longest of the times for the ratios in `TRACK_RATIOS`.
        """
        return max(sum(leg.seconds for leg in self.legs(setup, track)) for track in TRACK_RATIOS)


def setup(config: Config) -> Setup:
    """Return the setup of this robot: the speeds and lengths of its guided drive.

    Raises `GuideError` if the robot is too large or its limits are too low.
    """
    drive, limits = config.drive, config.limits
    slowing = math.sqrt(2 * STOP_DISTANCE_M * limits.linear_deceleration)
    speed = min(USUAL_SPEED, limits.linear_speed, slowing)
    wheel = min(MAX_ROLLING_SPEED, 0.9 * limits.wheel_speed * drive.wheel_radius)
    speed = min(speed, wheel)
    if speed < LEAST_SPEED or limits.angular_speed < LEAST_TURN:
        raise GuideError(
            f"the calibration needs at least {LEAST_SPEED} m/s and {LEAST_TURN} rad/s, but the "
            "configured limits are lower: either raise limits.linear_speed, "
            "limits.angular_speed, limits.wheel_speed or limits.linear_deceleration, or "
            "record a drive and use --log"
        )
    reach = REACH_RATIO * drive.wheel_separation + drive.wheel_radius / 2
    length = min(LONGEST, FLOOR_M - 2 * (reach + EDGE_MARGIN_M) - STOP_DISTANCE_M)
    if length < SHORTEST:
        raise GuideError(
            f"the robot is too large to be calibrated on a floor of {FLOOR_M:g} m x {FLOOR_M:g} m "
            f"(drive.wheel_separation = {drive.wheel_separation:g}): record a drive "
            "on a larger floor, and use --log"
        )
    return Setup(
        drive,
        speed,
        length,
        reach,
        limits.angular_speed,
        wheel,
        config.odometry,
        config.feedback,
    )
