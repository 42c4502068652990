"""How fast and how far this robot is driven, so that it stays on 3 m x 3 m and within its limits.

How far it truly turns is what is looked for: an effective track of once to two and a half times the
geometric one is allowed for. So whatever goes somewhere is driven there and back, or along a line
that the robot was set on, or turns that have been measured before.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.calibration.guided.steps import GuideError, Move
from acsard.config.settings import Config, DriveConfig

ROOM = 3.0
"""m, each way."""

MOST_S = 90.0
"""Of driving in all."""

SLOW, FASTEST_WHEEL = 0.3, 0.5
"""m/s that it drives, and that the faster side's wheels roll at most."""

BODY, EDGE = 0.75, 0.1
"""A robot reaches as far from its middle as this times its wheel separation, and half a wheel
radius more; m to the edge of the room."""

LONGEST, SHORTEST = 2.0, 0.8
"""m straight ahead: as far as it may, and at least."""

LEAST_SPEED, LEAST_TURN = 0.05, 0.2
"""m/s and rad/s that the limits must allow."""

STOPS_IN = 0.1
"""m that it may roll on when a leg ends."""

WIDEST = 2.5
"""Effective over geometric track that is allowed for; the least is 1."""


class Setup(Struct, frozen=True):
    """The robot and its room: m, m/s, rad/s."""

    drive: DriveConfig
    speed: float
    """Straight ahead."""
    length: float
    """Of the straight drive."""
    reach: float
    """From the robot's middle to its outermost point."""
    turning: float
    """The fastest turn that may be commanded."""
    wheel: float
    """The fastest that a side may roll."""

    @property
    def from_edge(self) -> float:
        """Where the robot's middle is to stand for the straight drive, from the near edge."""
        return self.reach + EDGE

    @property
    def to_middle(self) -> float:
        """From the end of the straight drive back to the middle of the room."""
        return self.from_edge + self.length - ROOM / 2

    def ahead(self, metres: float) -> Move:
        """Straight ahead, or back for less than 0."""
        return Move(abs(metres) / self.speed, math.copysign(self.speed, metres))

    def spin(self, rate: float, seconds: float) -> Move:
        """On the spot, at a rate in rad/s that is true for wheels that do not skid."""
        return Move(seconds, 0.0, self.command(rate))

    def arc(self, rate: float, metres: float) -> Move:
        """Ahead, or back for less than 0, while it turns."""
        way = self.ahead(metres)
        return Move(way.seconds, way.linear, self.command(rate))

    def turn(self, angle: float, rate: float, track: float) -> Move:
        """On the spot by an angle, rad, at a true rate in rad/s or what can be had of it; `track`:
        effective over geometric."""
        told = abs(self.command(rate * track))
        return Move(abs(angle) * track / (told * self._believed), 0.0, math.copysign(told, angle))

    def command(self, rate: float) -> float:
        """The command that turns the wheels against each other so fast, as far as they may."""
        most = min(2 * self.wheel / self.drive.wheel_separation, self.turning * self._believed)
        return max(-most, min(most, rate)) / self._believed

    @property
    def _believed(self) -> float:
        return self.drive.wheel_separation_multiplier


def setup(config: Config) -> Setup:
    """For this robot; raises `GuideError` when it is too large or held too slow."""
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
