"""Wished twist -> safe twist: speed, wheel saturation, acceleration, deceleration, jerk.

Two ways to move: `follow` a commander, each axis by its own limits; `coast` to rest without one,
both axes falling together so that no wheel's speed ever grows on the way down (invariant 2).
Jerk shapes speeding up only: what brakes the robot is never later for the sake of comfort.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.config.settings import LimitsConfig
from acsard.drive.kinematics import Kinematics
from acsard.values import REST, Twist


class _Axis(Struct, frozen=True):
    speed: float
    acceleration: float
    deceleration: float
    stop_deceleration: float
    jerk: float


class _State(Struct, frozen=True):
    twist: Twist
    linear_slope: float
    angular_slope: float


class Limiter:
    """Remembers the twist it last allowed and moves it by the limits."""

    def __init__(self, limits: LimitsConfig, kinematics: Kinematics) -> None:
        self._kinematics = kinematics
        self.state = _State(REST, 0.0, 0.0)
        """All it remembers; put back to undo a step whose line did not go out."""
        self.use(limits)

    def use(self, limits: LimitsConfig) -> None:
        """By these limits from now on; what is too fast for them falls by its deceleration.

        Not so where a wheel's limit is lowered, which holds at once: that is for a robot at rest.
        """
        self._linear = _Axis(
            limits.linear_speed,
            limits.linear_acceleration,
            limits.linear_deceleration,
            limits.linear_stop_deceleration,
            limits.linear_jerk,
        )
        self._angular = _Axis(
            limits.angular_speed,
            limits.angular_acceleration,
            limits.angular_deceleration,
            limits.angular_stop_deceleration,
            limits.angular_jerk,
        )
        self._wheel_speed = limits.wheel_speed

    @property
    def twist(self) -> Twist:
        """What was allowed last."""
        return self.state.twist

    def follow(self, wished: Twist, dt: float) -> Twist:
        """Move towards `wished` (finite) for `dt` s; what may be applied now."""
        goal = self._kinematics.saturate(self._within_speed(wished), self._wheel_speed)
        now = self.state
        linear, slope_v = _approach(
            now.twist.linear, goal.linear, now.linear_slope, dt, self._linear
        )
        angular, slope_w = _approach(
            now.twist.angular, goal.angular, now.angular_slope, dt, self._angular
        )
        # The axes move at their own pace, so a corner of the two can ask more of a wheel than
        # either end does.
        twist = self._kinematics.saturate(Twist(linear, angular), self._wheel_speed)
        self.state = _State(twist, slope_v, slope_w)
        return twist

    def coast(self, dt: float, stop: bool = False) -> Twist:
        """Fall towards rest for `dt` s, along the line to it; `stop` brakes by the stop limits.

        A negative `dt` changes nothing: it must not speed up the robot.
        """
        dt, twist = max(0.0, dt), self.twist
        seconds = max(
            abs(twist.linear) / _braking(self._linear, stop),
            abs(twist.angular) / _braking(self._angular, stop),
        )
        share = 1.0 - dt / seconds if seconds > dt else 0.0
        fallen = Twist(twist.linear * share, twist.angular * share) if share else REST
        self.state = _State(fallen, 0.0, 0.0)
        return fallen

    def cut(self) -> Twist:
        """Rest at once: there is nobody at the other end to ramp."""
        self.state = _State(REST, 0.0, 0.0)
        return REST

    def _within_speed(self, wished: Twist) -> Twist:
        """Both axes scaled together until each is within its limit: curvature is kept.

        An axis whose limit is 0 is left out, as those that a planar base does not have.
        """
        linear = wished.linear if self._linear.speed else 0.0
        angular = wished.angular if self._angular.speed else 0.0
        scale = 1.0
        if abs(linear) > self._linear.speed:
            scale = self._linear.speed / abs(linear)
        if abs(angular) * scale > self._angular.speed:
            scale = self._angular.speed / abs(angular)
        return Twist(linear * scale, angular * scale)


def _braking(axis: _Axis, stop: bool) -> float:
    return axis.stop_deceleration if stop else axis.deceleration


def _approach(
    speed: float, goal: float, slope: float, dt: float, axis: _Axis
) -> tuple[float, float]:
    """`speed` after `dt` on the way to `goal`, and the slope used, within the axis's limits."""
    if dt <= 0.0:
        return speed, slope
    # Through zero in two parts: what slows the robot is deceleration, what follows is not.
    target = 0.0 if speed * goal < 0 else goal
    most = axis.acceleration if abs(target) > abs(speed) else axis.deceleration
    wanted = (target - speed) / dt
    if axis.jerk and abs(target) > abs(speed):
        slope = slope if slope * wanted > 0 else 0.0  # left over from braking
        step = axis.jerk * dt
        most = min(most, abs(slope) + step, _flattenable(abs(target - speed), step, dt))
        # The slope may not fall faster than jerk either, as far as the goal is not passed; nor is
        # it steeper for jerk's sake than it may be: it braked, or what it may be was lowered.
        most = min(axis.acceleration, max(most, abs(slope) - step))
    used = max(-most, min(most, wanted))
    # Landing exactly: wanted * dt need not give the difference back in floating point.
    return (target if used == wanted else speed + used * dt), used


def _flattenable(away: float, step: float, dt: float) -> float:
    """The steepest slope from which falling by `step` every `dt` ends within `away`.

    Slopes s, s - step, ... over n more periods add up to dt ((n + 1) s - step n (n + 1) / 2).
    """
    n = math.floor((math.sqrt(1.0 + 8.0 * away / (step * dt)) - 1.0) / 2.0)
    return (away / dt + step * n * (n + 1) / 2.0) / (n + 1)
