"""Body twist <-> four wheel speeds of a four-wheel differential drive (skid-steer) base.

With v, w the linear and angular velocity of base_link, r_l and r_r the wheel radii, and L the
effective track (wheel separation x its multiplier: skidding wheels turn the robot as if they
stood further apart than they do):

    (1)  left = (front_left + rear_left) / 2      right = (front_right + rear_right) / 2
    (2)  v = (r_r right + r_l left) / 2
    (3)  w = (r_r right - r_l left) / L

and, solved for the wheels of a base that does both exactly,

    front_left = rear_left = (v - w L / 2) / r_l    front_right = rear_right = (v + w L / 2) / r_r
"""

from __future__ import annotations

from acsard.config.settings import DriveConfig
from acsard.values import Twist, WheelSpeeds


class Kinematics:
    """Converts between twist (m/s, rad/s, in base_link) and wheel speeds (rad/s)."""

    def __init__(self, drive: DriveConfig) -> None:
        self.multipliers = (
            drive.left_wheel_radius_multiplier,
            drive.right_wheel_radius_multiplier,
            drive.wheel_separation_multiplier,
        )
        self._left_radius = drive.wheel_radius * drive.left_wheel_radius_multiplier
        self._right_radius = drive.wheel_radius * drive.right_wheel_radius_multiplier
        self.track = drive.wheel_separation * drive.wheel_separation_multiplier
        """L, m."""

    @property
    def radius(self) -> float:
        """m, the mean of the sides' wheels."""
        return (self._left_radius + self._right_radius) / 2

    def wheel_speeds(self, twist: Twist) -> WheelSpeeds:
        """The wheel speeds that give this twist: equations (1) to (3) solved for them."""
        half = twist.angular * self.track / 2
        left = (twist.linear - half) / self._left_radius
        right = (twist.linear + half) / self._right_radius
        return WheelSpeeds(right, left, left, right)

    def twist(self, speeds: WheelSpeeds) -> Twist:
        """The twist these wheel speeds give, equations (1) to (3)."""
        linear, angular = self.moved(speeds.as_tuple())
        return Twist(linear, angular)

    def moved(self, wheels: tuple[float, float, float, float]) -> tuple[float, float]:
        """m and rad of the base by so many rad of its wheels, in `WHEELS` order; or both a second.

        What `twist` says, without values for it: each line asks several times.
        """
        front_right, front_left, rear_left, rear_right = wheels
        left = self._left_radius * (front_left + rear_left) / 2
        right = self._right_radius * (front_right + rear_right) / 2
        return (right + left) / 2, (right - left) / self.track

    def opposite(self, left: float, right: float, turn: float) -> tuple[float, float]:
        """How far the left wheels turn with `right` rad, and the right ones with `left` rad, if the
        base turns by `turn` rad: equation (3) solved for either side."""
        across = turn * self.track
        return (
            (self._right_radius * right - across) / self._left_radius,
            (self._left_radius * left + across) / self._right_radius,
        )

    def saturate(self, twist: Twist, wheel_speed: float) -> Twist:
        """The twist scaled down until no wheel exceeds `wheel_speed` rad/s; curvature is kept."""
        speeds = self.wheel_speeds(twist)
        fastest = max(abs(speeds.front_right), abs(speeds.front_left))
        if fastest <= wheel_speed:
            return twist
        scale = wheel_speed / fastest
        return Twist(twist.linear * scale, twist.angular * scale)
