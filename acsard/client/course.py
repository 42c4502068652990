"""Courses that end at a distance or an angle, measured by `odom`. This module is pure.

The speed falls with the rest of the way, to a speed so low that most robots stop within the
tolerance. One that rests elsewhere comes back. With coarse encoders, `odom` jumps across the end:
then the pose beside it that is nearer is the end.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from acsard.core.messages.schema import Odometry
from acsard.core.values import Twist

NEAR = 3.0  # times the tolerance, at rest: 6 mm or 0.7 degrees


class _Approach(NamedTuple):
    # Of the way that is left, in m or rad.
    deceleration: float
    gain: float  # of the speed near the end, 1/s
    slowest: float
    tolerance: float

    def speed(self, left: float, fastest: float) -> float:
        way = abs(left)
        speed = min(fastest, math.sqrt(2.0 * self.deceleration * way), self.gain * way)
        return math.copysign(max(self.slowest, speed), left)


_LINEAR = _Approach(0.3, 2.0, 0.02, 0.002)
_ANGULAR = _Approach(1.0, 2.0, 0.05, 0.004)


class Course(ABC):
    approach: ClassVar[_Approach]

    def __init__(self, way: float, speed: float) -> None:
        self.left = way  # to the end, m or rad
        self.speed = speed
        self._nearest = 0.0  # that `odom` showed when it jumped across the end

    @abstractmethod
    def odom(self, odom: Odometry) -> None:
        """Process a message."""

    @property
    @abstractmethod
    def twist(self) -> Twist: ...

    @property
    @abstractmethod
    def left_text(self) -> str: ...

    @property
    def is_done(self) -> bool:
        return abs(self.left) <= max(self.approach.tolerance, self._nearest)

    def settle(self) -> bool:
        """Return whether a robot that rests is near the end. If not, it has to come back."""
        near = abs(self.left) <= max(NEAR * self.approach.tolerance, self._nearest)
        self._nearest = 0.0
        return near

    def _shows(self, left: float) -> None:
        if self.left * left < 0.0:
            self._nearest = min(abs(self.left), abs(left))
        self.left = left


class Straight(Course):
    approach = _LINEAR

    def __init__(self, odom: Odometry, distance: float, speed: float) -> None:
        super().__init__(distance, speed)
        position = odom.pose.pose.position
        self._x, self._y, self._yaw = position.x, position.y, odom.yaw
        self._distance, self._turned = distance, 0.0

    def odom(self, odom: Odometry) -> None:
        position = odom.pose.pose.position
        x, y = position.x - self._x, position.y - self._y
        self._shows(self._distance - x * math.cos(self._yaw) - y * math.sin(self._yaw))
        self._turned = math.remainder(odom.yaw - self._yaw, math.tau)

    @property
    def twist(self) -> Twist:
        # Keep the heading, at less than half of the usual turn rate.
        turn = max(-0.4, min(0.4, -_ANGULAR.gain * self._turned))
        return Twist(self.approach.speed(self.left, self.speed), turn)

    @property
    def left_text(self) -> str:
        return f"{self.left:.3f} m"


class Turn(Course):
    approach = _ANGULAR

    def __init__(self, odom: Odometry, angle: float, speed: float) -> None:
        super().__init__(angle, speed)
        self._yaw = odom.yaw

    def odom(self, odom: Odometry) -> None:
        self._shows(self.left - math.remainder(odom.yaw - self._yaw, math.tau))
        self._yaw = odom.yaw

    @property
    def twist(self) -> Twist:
        return Twist(0.0, self.approach.speed(self.left, self.speed))

    @property
    def left_text(self) -> str:
        return f"{math.degrees(self.left):.1f} degrees"
