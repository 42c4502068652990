"""The tables of a guided drive: legs to drive, numbers to ask for, and what they measure.

A way of calibration is a `Way`: the numbers to ask for first, and its legs in order. `ways.py` has
the table of the ways, and `runner.py` leads a person through one of them.

The robot stays on 3 m x 3 m and within its limits. The true turns are unknown, since they are what
the calibration measures. The plan allows for an effective track of 1 to 2.5 times the geometric
one. Each drive therefore goes there and back, follows a line that the robot was set on, or comes
after turns that were measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import Config, DriveConfig
from acsard.core.values import AcsardError
from acsard.terminal.prompt import Ask


class GuideError(AcsardError):
    """End of a guided drive that cannot continue. The text says why and what to do.

    Nothing has been written.
    """


class Move(Struct, frozen=True):
    """A command that is held for a time."""

    seconds: float
    linear: float = 0.0
    """Linear speed, m/s."""
    angular: float = 0.0
    """Turn rate, rad/s, positive to the left."""


UNITS = {"m": 1.0, "mm": 1e-3, "deg": math.pi / 180}
"""Units of the numbers that a person reads off, in m or rad."""


What = Literal["turned", "angle", "distance", "ahead", "aside"]
"""Kind of a reading. `turned` is an angle that includes whole turns, and `angle` one that does not.

Both are in rad, positive to the left. The other kinds are in m.
"""


class Mean(Struct, frozen=True):
    """A measurement: the mean of some answers, plus a known part."""

    what: What
    answers: tuple[str, ...]
    deviation: float
    """Standard deviation, m or rad."""
    plus: float = 0.0
    """The known part, m or rad: whole turns that nobody measures."""
    over: tuple[str, ...] = ()
    """Names of the legs in which the robot moved by this much; without any, the leg itself."""


class Slant(Struct, frozen=True):
    """A measurement: the turn of the robot relative to a line, by two distances from the line.

    `near` and `far` are the answers of the end that comes closer to the line by a turn to the left
    and of the end that goes away from it. `apart` is the distance between both ends, which was
    asked for before the first leg.
    """

    what: What
    near: str
    far: str
    apart: str
    since: str = ""
    """Name of the leg after which the robot's angle to the line was measured before.

    Without one, a person set the robot along the line.
    """
    plus: float = 0.0
    """Whole and half turns, rad."""
    over: tuple[str, ...] = ()
    """As in `Mean`."""


Measure = Mean | Slant


class Leg(Struct, frozen=True):
    """A series of moves that a person starts with Enter and stops with any key."""

    name: str
    words: str
    """Instructions to the person, and an announcement of the moves."""
    moves: tuple[Move, ...]
    asks: tuple[Ask, ...] = ()
    """Numbers that the person reads off after the moves."""
    measures: tuple[Measure, ...] = ()
    """The meaning of the numbers."""
    by_key: bool = False
    """Whether a key press is the normal end of the last move, whose duration is then a timeout."""

    @property
    def seconds(self) -> float:
        return sum(move.seconds for move in self.moves)


ROOM = 3.0
"""Side of the free floor, m."""

MOST_S = 90.0
"""Longest driving time in all, s."""

SLOW, FASTEST_WHEEL = 0.3, 0.5
"""Usual speed of the robot, and largest rolling speed of the faster side's wheels, m/s."""

BODY, EDGE = 0.75, 0.1
"""Robot size and margin.

The robot reaches `BODY` wheel separations plus half a wheel radius from its middle. `EDGE` is the
margin to the edge of the floor, m.
"""

LONGEST, SHORTEST = 2.0, 0.8
"""Longest and shortest straight drive, m."""

LEAST_SPEED, LEAST_TURN = 0.05, 0.2
"""Speed in m/s and turn rate in rad/s that the limits must at least allow."""

STOPS_IN = 0.1
"""Distance that the robot may roll on when a leg ends, m."""

WIDEST = 2.5
"""Largest ratio of effective to geometric track that the plan allows for. The smallest is 1."""


class Setup(Struct, frozen=True):
    """The robot and its drive plan, in m, m/s and rad/s."""

    drive: DriveConfig
    speed: float
    """Speed straight ahead, m/s."""
    length: float
    """Length of the straight drive, m."""
    reach: float
    """Distance from the robot's middle to its outermost point, m."""
    turning: float
    """Fastest turn that may be commanded, rad/s."""
    wheel: float
    """Fastest rolling speed of one side, m/s."""

    @property
    def from_edge(self) -> float:
        """Distance of the robot's middle from the near edge before the straight drive, m."""
        return self.reach + EDGE

    @property
    def to_middle(self) -> float:
        """Distance from the end of the straight drive back to the middle of the floor, m."""
        return self.from_edge + self.length - ROOM / 2

    def ahead(self, metres: float) -> Move:
        """Return a straight move; a negative distance goes backwards."""
        return Move(abs(metres) / self.speed, math.copysign(self.speed, metres))

    def spin(self, rate: float, seconds: float) -> Move:
        """Return a turn on the spot.

        `rate` is in rad/s and would be the true rate if the wheels did not skid.
        """
        return Move(seconds, 0.0, self.command(rate))

    def arc(self, rate: float, metres: float) -> Move:
        """Return a curve; a negative distance goes backwards. `rate` is as in `spin`."""
        way = self.ahead(metres)
        return Move(way.seconds, way.linear, self.command(rate))

    def turn(self, angle: float, rate: float, track: float) -> Move:
        """Return a turn on the spot by a true angle.

        Args:
            angle: the true angle in rad, positive to the left.
            rate: the wanted true rate in rad/s; the limits may reduce it.
            track: the ratio of effective to geometric track.
        """
        told = abs(self.command(rate * track))
        return Move(abs(angle) * track / (told * self._believed), 0.0, math.copysign(told, angle))

    def command(self, rate: float) -> float:
        """Return the angular command for a turn rate without skidding, within the limits, rad/s."""
        most = min(2 * self.wheel / self.drive.wheel_separation, self.turning * self._believed)
        return max(-most, min(most, rate)) / self._believed

    @property
    def _believed(self) -> float:
        return self.drive.wheel_separation_multiplier


Legs = Callable[[Setup, float], tuple[Leg, ...]]
"""The legs for a setup and a ratio of effective to geometric track.

The legs up to the first reading of whole turns do not depend on the track, which that reading
tells.
"""

TRACKS = [1.0 + 0.05 * step for step in range(round((WIDEST - 1.0) / 0.05) + 1)]
"""Ratios of effective to geometric track for which the driving time is computed.

The time is not monotonic: a smaller track lets more whole turns fit into the time allowed.
"""


class Way(Struct, frozen=True):
    """A way of calibration by a guided drive."""

    legs: Legs
    asks: tuple[Ask, ...] = ()
    """Numbers that the person reads off before the first leg."""
    tool: str = ""
    """The tool whose readings are compared with the wheels, in words; "" for a sensor."""

    def longest_s(self, setup: Setup) -> float:
        """Return the longest driving time, s, whatever the effective track is."""
        return max(sum(leg.seconds for leg in self.legs(setup, track)) for track in TRACKS)


def setup(config: Config) -> Setup:
    """Return the plan for this robot.

    Raises `GuideError` if it is too large or its limits are too low.
    """
    drive, limits = config.drive, config.limits
    speed = min(SLOW, limits.linear_speed, math.sqrt(2 * STOPS_IN * limits.linear_deceleration))
    wheel = min(FASTEST_WHEEL, 0.9 * limits.wheel_speed * drive.wheel_radius)
    speed = min(speed, wheel)
    if speed < LEAST_SPEED or limits.angular_speed < LEAST_TURN:
        raise GuideError(
            f"the robot may not drive at {LEAST_SPEED} m/s and turn at {LEAST_TURN} rad/s: raise "
            "limits.linear_speed, limits.angular_speed, limits.wheel_speed or "
            "limits.linear_deceleration, or record a drive and use --log"
        )
    reach = BODY * drive.wheel_separation + drive.wheel_radius / 2
    length = min(LONGEST, ROOM - 2 * (reach + EDGE) - STOPS_IN)
    if length < SHORTEST:
        raise GuideError(
            f"the robot is too large to be calibrated on {ROOM:g} m x {ROOM:g} m "
            f"(drive.wheel_separation = {drive.wheel_separation:g}): record a drive where there "
            "is room, and use --log"
        )
    return Setup(drive, speed, length, reach, limits.angular_speed, wheel)
