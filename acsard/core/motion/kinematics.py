"""Converts between the twist and the wheel speeds of a differential-drive base.

    (1)  left = (front_left + rear_left) / 2      right = (front_right + rear_right) / 2
    (2)  v = (r_r right + r_l left) / 2
    (3)  w = (r_r right - r_l left) / L

v and w are of base_link, m/s and rad/s, r_l and r_r the radii of the sides, m, and L the effective
track, m: wheels that skid turn the robot as if they were further apart.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import DriveConfig
from acsard.core.values import Metres, Rad, RadPerS, Twist, Wheels4, WheelSpeeds


class Kinematics:
    """Converts between twists of base_link (m/s, rad/s) and wheel speeds (rad/s)."""

    def __init__(self, drive: DriveConfig) -> None:
        self.multipliers = (
            drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier,
            drive.wheel_separation_multiplier,
        )
        self._left_radius = drive.wheel_radius * drive.left_wheel_radius_multiplier
        self._right_radius = drive.wheel_radius * drive.right_wheel_radius_multiplier
        # Effective track L, m.
        self.track = drive.wheel_separation * drive.wheel_separation_multiplier

    @property
    def radius(self) -> float:
        # m
        return (self._left_radius + self._right_radius) / 2

    def wheel_speeds(self, twist: Twist) -> WheelSpeeds:
        half = twist.angular * self.track / 2
        left = (twist.linear - half) / self._left_radius
        right = (twist.linear + half) / self._right_radius
        return WheelSpeeds(right, left, left, right)

    def twist(self, speeds: WheelSpeeds) -> Twist:
        linear, angular = self.moved(speeds.as_tuple())
        return Twist(linear, angular)

    def moved(self, wheels: Wheels4) -> tuple[float, float]:
        """Return the distance, m, and the turn, rad, of rolled angles (or both per s of speeds)."""
        front_right, front_left, rear_left, rear_right = wheels
        left = self._left_radius * (front_left + rear_left) / 2
        right = self._right_radius * (front_right + rear_right) / 2
        return (right + left) / 2, (right - left) / self.track

    def opposite(self, left: Rad, right: Rad, turn: Rad) -> tuple[Rad, Rad]:
        """Return the angle of each side computed from the other one and the turn (equation 3)."""
        across = turn * self.track
        return (
            (self._right_radius * right - across) / self._left_radius,
            (self._left_radius * left + across) / self._right_radius,
        )

    def saturate(self, twist: Twist, wheel_speed: RadPerS) -> Twist:
        """Return `twist`, scaled down so that no wheel turns faster than `wheel_speed`."""
        speeds = self.wheel_speeds(twist)
        fastest = max(abs(speeds.front_right), abs(speeds.front_left))
        if fastest <= wheel_speed:
            return twist
        scale = wheel_speed / fastest
        return Twist(twist.linear * scale, twist.angular * scale)

    def fits(self, twist: Twist, wheel_speed: RadPerS) -> bool:
        """Return whether no wheel turns faster than `wheel_speed`, but for rounding."""
        speeds = self.wheel_speeds(twist)
        return max(abs(speeds.front_right), abs(speeds.front_left)) <= wheel_speed * (1.0 + 1e-12)

    def room(self, base: Twist, added: Twist, wheel_speed: RadPerS) -> float:
        """Return the fraction of `added`, 0 to 1, that fits on top of `base` in `wheel_speed`."""
        first, second, share = self.wheel_speeds(base), self.wheel_speeds(added), 1.0
        sides = (first.front_right, second.front_right), (first.front_left, second.front_left)
        for speed, more in sides:
            if more:
                share = min(share, (math.copysign(wheel_speed, more) - speed) / more)
        return max(0.0, share)


def on_arc(yaw: Rad, distance: Metres, turn: Rad) -> tuple[Metres, Metres, Rad]:
    """Return x and y of the chord of an arc from the heading `yaw`, and the heading at its end.

    The chord has the length d sin(a / 2) / (a / 2) and the direction yaw + a / 2.
    """
    half = turn / 2
    # sin(h)/h is accurate in doubles down to tiny h. Only h = 0 needs its limit.
    chord = distance * (math.sin(half) / half if half else 1.0)
    heading, end = yaw + half, yaw + turn
    if not -math.pi <= end <= math.pi:
        end = math.remainder(end, math.tau)
    return chord * math.cos(heading), chord * math.sin(heading), end
