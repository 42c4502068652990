"""Courses that end at a distance or an angle, measured by `odom`. This module is pure.

The speed falls with the rest of the way, to a speed so low that most robots stop within the
tolerance. One that rests elsewhere comes back. `odom` may jump across the end, because coarse
encoders show no pose that is nearer.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

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

    def ends(self, left: float, before: float) -> bool:
        # `before` was left before the last motion.
        return abs(left) <= self.tolerance or (left * before < 0.0 and abs(left) <= abs(before))

    def is_near(self, left: float, before: float) -> bool:
        return abs(left) <= NEAR * self.tolerance or self.ends(left, before)


_LINEAR = _Approach(0.3, 2.0, 0.02, 0.002)
_ANGULAR = _Approach(1.0, 2.0, 0.05, 0.004)


class Course(Protocol):
    left: float  # way to the end, m or rad

    def odom(self, odom: Odometry) -> None:
        """Process a message."""

    @property
    def is_done(self) -> bool: ...

    def settle(self, odom: Odometry | None) -> bool:
        """Process the message of a robot that rests, and return whether it is near the end."""

    @property
    def twist(self) -> Twist: ...

    @property
    def left_text(self) -> str: ...


class Straight:
    def __init__(self, odom: Odometry, distance: float, speed: float) -> None:
        position = odom.pose.pose.position
        self._x, self._y, self._yaw = position.x, position.y, odom.yaw
        self._distance, self._speed = distance, speed
        self.left = self._before = distance
        self.odom(odom)

    def odom(self, odom: Odometry) -> None:
        position = odom.pose.pose.position
        x, y = position.x - self._x, position.y - self._y
        left = self._distance - x * math.cos(self._yaw) - y * math.sin(self._yaw)
        if left != self.left:
            self._before, self.left = self.left, left
        self._turned = math.remainder(odom.yaw - self._yaw, math.tau)

    @property
    def is_done(self) -> bool:
        return _LINEAR.ends(self.left, self._before)

    def settle(self, odom: Odometry | None) -> bool:
        before = self._before
        if odom is not None:
            self.odom(odom)
        self._before = self.left
        return _LINEAR.is_near(self.left, before)

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
        self._speed, self._yaw = speed, odom.yaw
        self.left = self._before = angle

    def odom(self, odom: Odometry) -> None:
        turned = math.remainder(odom.yaw - self._yaw, math.tau)
        if turned:
            self._before, self.left, self._yaw = self.left, self.left - turned, odom.yaw

    @property
    def is_done(self) -> bool:
        return _ANGULAR.ends(self.left, self._before)

    def settle(self, odom: Odometry | None) -> bool:
        before = self._before
        if odom is not None:
            self.odom(odom)
        self._before = self.left
        return _ANGULAR.is_near(self.left, before)

    @property
    def twist(self) -> Twist:
        return Twist(0.0, _ANGULAR.speed(self.left, self._speed))

    @property
    def left_text(self) -> str:
        return f"{math.degrees(self.left):.1f} degrees"
