"""Converts between the twist and the wheel speeds of a four-wheel differential-drive base.

Let v be the linear velocity of base_link, m/s, and w its angular velocity, rad/s. Let r_l and r_r
be the wheel radii of the left and the right side, m, and L the effective track, m. L is the wheel
separation times its multiplier: wheels that skid turn the robot as if they were further apart. The
mean wheel speeds of the two sides are called left and right, rad/s.

    (1)  left = (front_left + rear_left) / 2      right = (front_right + rear_right) / 2
    (2)  v = (r_r right + r_l left) / 2
    (3)  w = (r_r right - r_l left) / L

The wheel speeds of a given twist are

    front_left = rear_left = (v - w L / 2) / r_l    front_right = rear_right = (v + w L / 2) / r_r
"""

from __future__ import annotations

import math

from acsard.core.config.settings import DriveConfig
from acsard.core.values import Twist, WheelSpeeds


class Kinematics:
    """Converts between twists of base_link (m/s, rad/s) and wheel speeds (rad/s) of one robot."""

    def __init__(self, drive: DriveConfig) -> None:
        self.multipliers = (
            drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier,
            drive.wheel_separation_multiplier,
        )
        self._left_radius = drive.wheel_radius * drive.left_wheel_radius_multiplier
        self._right_radius = drive.wheel_radius * drive.right_wheel_radius_multiplier
        self.track = drive.wheel_separation * drive.wheel_separation_multiplier
        """The effective track L, m: the distance between the wheels that makes turns come out
        right."""

    @property
    def radius(self) -> float:
        """Mean of the wheel radii of both sides, m."""
        return (self._left_radius + self._right_radius) / 2

    def wheel_speeds(self, twist: Twist) -> WheelSpeeds:
        """Return the wheel speeds, rad/s, that move the base with this twist."""
        half = twist.angular * self.track / 2
        left = (twist.linear - half) / self._left_radius
        right = (twist.linear + half) / self._right_radius
        return WheelSpeeds(right, left, left, right)

    def twist(self, speeds: WheelSpeeds) -> Twist:
        """Return the twist, m/s and rad/s, that these wheel speeds cause."""
        linear, angular = self.moved(speeds.as_tuple())
        return Twist(linear, angular)

    def moved(self, wheels: tuple[float, float, float, float]) -> tuple[float, float]:
        """Return the distance (m) and the turn (rad) of the base after the wheels have rolled.

        `wheels` contains the angles that the wheels rolled (rad), in `WHEELS` order. If `wheels`
        contains wheel speeds (rad/s) instead, the result is in m/s and rad/s.
        """
        front_right, front_left, rear_left, rear_right = wheels
        left = self._left_radius * (front_left + rear_left) / 2
        right = self._right_radius * (front_right + rear_right) / 2
        return (right + left) / 2, (right - left) / self.track

    def opposite(self, left: float, right: float, turn: float) -> tuple[float, float]:
        """Return the angles of the left and the right wheels, each computed from the other side.

        The left angle follows from `right` and `turn`, and the right angle from `left` and `turn`
        (equation 3). All angles are in rad. `left` and `right` are the measured angles: the means
        of the two wheels of each side. `turn` is the turn of the base.
        """
        across = turn * self.track
        return (
            (self._right_radius * right - across) / self._left_radius,
            (self._left_radius * left + across) / self._right_radius,
        )

    def saturate(self, twist: Twist, wheel_speed: float) -> Twist:
        """Return `twist`, scaled down so that no wheel turns faster than `wheel_speed` rad/s."""
        speeds = self.wheel_speeds(twist)
        fastest = max(abs(speeds.front_right), abs(speeds.front_left))
        if fastest <= wheel_speed:
            return twist
        scale = wheel_speed / fastest
        return Twist(twist.linear * scale, twist.angular * scale)

    def fits(self, twist: Twist, wheel_speed: float) -> bool:
        """Return whether no wheel turns faster than `wheel_speed` rad/s with this twist.

        A difference that rounding can cause does not count.
        """
        speeds = self.wheel_speeds(twist)
        return max(abs(speeds.front_right), abs(speeds.front_left)) <= wheel_speed * (1.0 + 1e-12)

    def room(self, base: Twist, added: Twist, wheel_speed: float) -> float:
        """Return the largest fraction of `added`, 0 to 1, that can be added to the twist `base`.

        With the sum of these twists, no wheel may turn faster than `wheel_speed` rad/s. The
        fraction is 0 if `base` alone exceeds this speed.
        """
        first, second, share = self.wheel_speeds(base), self.wheel_speeds(added), 1.0
        sides = (first.front_right, second.front_right), (first.front_left, second.front_left)
        for speed, more in sides:
            if more:
                share = min(share, (math.copysign(wheel_speed, more) - speed) / more)
        return max(0.0, share)
