"""The types of a guided drive: `Method`, `Leg`, `Move` and measurements, and the robot's `Setup`.

It does not import numpy, so that `acsard calibrate` starts quickly. A drive stays on a floor of 3 m
x 3 m for each effective track of 1 to 2.5 times the wheel separation, which is unknown before: it
goes out and back on the same path, is straight from a known pose, or follows a turn that a person
measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config, DriveConfig, FeedbackConfig, OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import AcsardError, Metres, Rad, RadPerS, Twist
from acsard.terminal.prompt import NumberQuestion

# Equipment that the person needs, by the name in `--method`.
NEEDS: dict[str, str] = {
    "gyro": "a gyro on the Zenoh key imu, and a tape measure",
    "positions": "positions of the robot on a Zenoh key",
    "tape": "a tape measure and a straight line on the floor",
}


class GuideError(AcsardError):
    """The guided drive cannot continue. The text says why and what to do. No file was changed."""


class DisturbedError(GuideError):
    """A part of the guided drive was cut short for a temporary reason, and can be repeated."""

    def __init__(self, why: str, text: str) -> None:
        super().__init__(text)
        self.why = why


class Move(Struct, frozen=True):
    """A twist, and the time for which the tool commands it; a pause if the twist is zero."""

    seconds: float
    linear: float = 0.0  # linear speed, m/s
    angular: RadPerS = 0.0  # commanded turn rate, positive to the left


UNITS = {"m": 1.0, "mm": 1e-3}  # factors that convert the units of the person's answers to m


# Motion since the pose was last known: the turn, rad, left is +, with whole turns (`turned`) or
# without (`angle`), or the straight-line `distance`, m.
Quantity = Literal["turned", "angle", "distance"]


class Distance(Struct, frozen=True):
    """A straight-line distance of the leg just driven, which a person measures by tape."""

    answer: str  # name of the answer
    deviation: Metres  # standard deviation of the answer


class Slant(Struct, frozen=True):
    """The robot's turn, from the distances of two points of the robot to a line on the floor."""

    quantity: Literal["turned", "angle"]
    near: str  # answer: distance of the point that a turn to the left moves towards the line
    far: str  # the same of the point that it moves away
    apart: str  # answer before the first leg: distance between the two points
    # Earlier leg after which the start angle was measured; "" if the robot started parallel.
    since: str = ""
    plus: Rad = 0.0  # whole turns to add, because the distances to the line do not show them
    over: tuple[str, ...] = ()  # legs whose total motion was measured; () is the last one


Measure = Distance | Slant


class Leg(Struct, frozen=True):
    """A series of moves that a person starts with Enter and can stop at any time with any key."""

    name: str
    words: str  # tells the person what to do and how the robot will move
    moves: tuple[Move, ...]
    asks: tuple[NumberQuestion, ...] = ()  # questions that the person answers after the moves
    measures: tuple[Measure, ...] = ()
    by_key: bool = False  # the person ends the last move; its duration is a timeout

    @property
    def seconds(self) -> float:
        return sum(move.seconds for move in self.moves)


FLOOR_M = 3.0  # side length of the square floor that must be free

USUAL_SPEED = 0.3  # m/s straight ahead, unless the robot's limits are lower

MAX_ROLLING_SPEED = 0.5  # of the wheels while the robot turns, m/s

REACH_RATIO = 0.75  # assumed distance from middle to outermost point / wheel separation

EDGE_MARGIN_M = 0.1  # distance to keep between the robot and the edge of the floor

LONGEST, SHORTEST = 2.0, 0.8  # largest and smallest length of the straight drive, m

# Limits, m/s and rad/s, below which a guided drive is not possible.
LEAST_SPEED, LEAST_TURN = 0.05, 0.2

STOP_DISTANCE_M = 0.1  # distance that the robot may still roll after a leg has ended

MAX_TRACK_RATIO = 2.5  # of effective track to wheel separation; the smallest is 1


class Setup(Struct, frozen=True):
    """The robot, and the speeds and lengths of its guided drive."""

    drive: DriveConfig
    speed: float  # speed straight ahead, m/s
    length: Metres  # length of the straight drive
    reach: Metres  # distance from the robot's middle to its outermost point
    max_command_rate: RadPerS  # largest turn rate that the robot's limits permit in a command
    max_rolling_speed: float  # largest rolling speed of the wheels while the robot turns, m/s
    odometry: OdometryConfig = OdometryConfig()
    feedback: FeedbackConfig = FeedbackConfig()

    @property
    def from_edge(self) -> float:
        """Distance from the free floor's edge at which a person places the robot's middle, m."""
        return self.reach + EDGE_MARGIN_M

    @property
    def to_middle(self) -> float:
        """Distance from the end of the straight drive back to the middle of the free floor, m."""
        return self.from_edge + self.length - FLOOR_M / 2

    def ahead(self, metres: float) -> Move:
        """Return a straight move of `metres` m. A negative distance is a move backwards."""
        return Move(abs(metres) / self.speed, math.copysign(self.speed, metres))

    def spin(self, rate: float, seconds: float) -> Move:
        """Return a turn in place; `rate` is that of a robot that does not skid, left is +."""
        return Move(seconds, 0.0, self.command(rate))

    def arc(self, rate: float, metres: float) -> Move:
        """Return a curve; `rate` is that without skidding. A negative length is backwards."""
        straight = self.ahead(metres)
        return Move(straight.seconds, straight.linear, self.command(rate))

    def turn(self, angle: float, rate: float, track: float) -> Move:
        """Return a turn in place by `angle`, left is +, whose command compensates for skidding.

        `rate` is the true turn rate, and `track` the ratio of effective track to wheel separation.
        """
        command = abs(self.command(rate * track))
        seconds = abs(angle) * track / (command * self.rate_per_command)
        return Move(seconds, 0.0, math.copysign(command, angle))

    def command(self, rate: float) -> float:
        """Return the command for a turn at `rate` without skidding, within the robot's limits."""
        per_command = self.rate_per_command
        most = min(
            2 * self.max_rolling_speed / self.drive.wheel_separation,
            self.max_command_rate * per_command,
        )
        return max(-most, min(most, rate)) / per_command

    @property
    def rate_per_command(self) -> float:
        """Turn rate without skidding, rad/s, of a command of 1 rad/s: multipliers change it."""
        bare = replace(
            self.drive, wheel_separation_multiplier=1.0, left_wheel_radius_multiplier=1.0,
            right_wheel_radius_multiplier=1.0,
        )  # fmt: skip
        commanded = Kinematics(self.drive).wheel_speeds(Twist(0.0, 1.0))
        return Kinematics(bare).twist(commanded).angular


# Returns the legs for the ratio of effective track to separation. The legs up to the first `turned`
# measurement, which shows this ratio, must not depend on it.
Legs = Callable[[Setup, float], tuple[Leg, ...]]

# Not only the largest ratio, because with a smaller one a leg may have one more full turn.
TRACK_RATIOS = [1.0 + 0.05 * step for step in range(round((MAX_TRACK_RATIO - 1.0) / 0.05) + 1)]


class Method(Struct, frozen=True):
    """A method of calibration by a guided drive."""

    legs: Legs
    asks: tuple[NumberQuestion, ...] = ()  # questions that the person answers before the first leg
    by_tape: bool = False  # a person measures the motion; otherwise a sensor does

    def longest_s(self, setup: Setup) -> float:
        """Return the driving time of all legs for the least favorable of `TRACK_RATIOS`, s."""
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
