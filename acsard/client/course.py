"""Courses that end at a distance or an angle, measured by `odom`. This module is pure.

The speed falls with the rest of the way, to a speed so low that the robot stops within the
tolerance: 5 mm and 0.5 degrees in the simulator. A robot that overshoots comes back.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from acsard.core.messages.schema import Odometry
from acsard.core.values import Twist


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


class Course(Protocol):
    left: float  # way to the end, m or rad

    def odom(self, odom: Odometry) -> None:
        """Process a message."""

    @property
    def is_done(self) -> bool: ...

    @property
    def twist(self) -> Twist: ...

    @property
    def left_text(self) -> str: ...


class Straight:
    def __init__(self, odom: Odometry, distance: float, speed: float) -> None:
        position = odom.pose.pose.position
        self._x, self._y, self._yaw = position.x, position.y, odom.yaw
        self._distance, self._speed = distance, speed
        self.odom(odom)

    def odom(self, odom: Odometry) -> None:
        position = odom.pose.pose.position
        x, y = position.x - self._x, position.y - self._y
        self.left = self._distance - x * math.cos(self._yaw) - y * math.sin(self._yaw)
        self._turned = math.remainder(odom.yaw - self._yaw, math.tau)

    @property
    def is_done(self) -> bool:
        return abs(self.left) <= _LINEAR.tolerance

    @property
    def twist(self) -> Twist:
        # Keep the heading, at less than half of the usual turn rate.
        turn = max(-0.4, min(0.4, -_ANGULAR.gain * self._turned))
        return Twist(_LINEAR.speed(self.left, self._speed), turn)

    @property
    def left_text(self) -> str:
        return f"{self.left:.3f} m"


class Turn:
    def __init__(self, odom: Odometry, angle: float, speed: float) -> None:
        self.left, self._speed, self._yaw = angle, speed, odom.yaw

    def odom(self, odom: Odometry) -> None:
        self.left -= math.remainder(odom.yaw - self._yaw, math.tau)
        self._yaw = odom.yaw

    @property
    def is_done(self) -> bool:
        return abs(self.left) <= _ANGULAR.tolerance

    @property
    def twist(self) -> Twist:
        return Twist(0.0, _ANGULAR.speed(self.left, self._speed))

    @property
    def left_text(self) -> str:
        return f"{math.degrees(self.left):.1f} degrees"
