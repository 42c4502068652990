"""Limits a requested twist: speed, wheel saturation, acceleration, deceleration and jerk.

`follow` moves both axes separately towards a command. `coast` reduces them in proportion, or a
wheel could speed up (rule 2 of `acsard/README.md`). Jerk is limited only for speeding up, because
comfort must not delay braking.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.config.settings import LimitsConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import REST, Twist


class _Axis(Struct, frozen=True):
    speed: float
    acceleration: float
    deceleration: float
    stop_deceleration: float
    jerk: float


class State(Struct, frozen=True):
    twist: Twist
    linear_slope: float
    angular_slope: float


class Limiter:
    """Moves the allowed twist step by step towards a requested twist, within the limits."""

    def __init__(self, limits: LimitsConfig, kinematics: Kinematics) -> None:
        self._kinematics = kinematics
        self.state = State(REST, 0.0, 0.0)  # `Robot` resets it to that of the last line
        self._cap = math.inf
        self.use(limits)

    def use(self, limits: LimitsConfig) -> None:
        """Use other limits; a faster robot slows down at the configured deceleration.

        A lower wheel speed takes effect without a ramp, so lower it only at rest.
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
        self._wished = self._goal = REST  # requested, and within the speed limits
        self._arrived: State | None = None  # `_goal` is reached, and kept

    def cap(self, speed: float) -> None:
        """Allow at most this linear speed, too; a faster robot slows down as configured."""
        self._cap = speed
        self._wished = self._goal = REST
        self._arrived = None

    @property
    def twist(self) -> Twist:
        """The allowed twist of the last step."""
        return self.state.twist

    def follow(self, wished: Twist, dt: float) -> Twist:
        """Move the allowed twist towards a finite one for `dt` s, and return it."""
        if wished is not self._wished:  # most steps have the same command as the step before
            self._wished, self._arrived = wished, None
            self._goal = self._kinematics.saturate(self._within_speed(wished), self._wheel_speed)
        goal, now = self._goal, self.state
        if now is self._arrived:
            return now.twist
        linear, slope_v = _approach(
            now.twist.linear, goal.linear, now.linear_slope, dt, self._linear
        )
        angular, slope_w = _approach(
            now.twist.angular, goal.angular, now.angular_slope, dt, self._angular
        )
        twist = self._fitted(Twist(linear, angular))
        self.state = State(twist, slope_v, slope_w)
        if dt > 0.0 and twist == goal and slope_v == slope_w == 0.0:
            self._arrived = self.state
        return twist

    def _fitted(self, twist: Twist) -> Twist:
        kinematics, most, now = self._kinematics, self._wheel_speed, self.twist
        if kinematics.fits(twist, most):
            return twist
        # On the way, both axes together may need a faster wheel than at the start or at the goal.
        # So one axis changes as far as it may, and the other one as far as the wheels allow. An
        # axis that slows down goes first, because braking must not wait.
        changes = [Twist(twist.linear - now.linear), Twist(angular=twist.angular - now.angular)]
        turns_slower = abs(twist.angular) < abs(now.angular)
        if turns_slower and abs(twist.linear) >= abs(now.linear):
            changes.reverse()
        # If the wheels do not allow the whole change of the first axis, the second one goes first.
        first, second = (kinematics.fits(_sum(now, change), most) for change in changes)
        if second and not first:
            changes.reverse()
        fitted = now
        for change in changes:
            fitted = _sum(fitted, change, kinematics.room(fitted, change, most))
        # Rounding has added an error.
        return kinematics.saturate(fitted, most)

    def coast(self, dt: float, stop: bool = False) -> Twist:
        """Slow down towards rest for `dt` s, both speeds in proportion; return the allowed twist.

        `stop` uses `*_stop_deceleration`. A negative `dt` is 0, and cannot speed up the robot.
        """
        dt, twist = max(0.0, dt), self.twist
        seconds = max(
            abs(twist.linear) / _braking(self._linear, stop),
            abs(twist.angular) / _braking(self._angular, stop),
        )
        share = 1.0 - dt / seconds if seconds > dt else 0.0
        fallen = Twist(twist.linear * share, twist.angular * share) if share else REST
        self.state = State(fallen, 0.0, 0.0)
        return fallen

    def cut(self) -> Twist:
        """Set the allowed twist to zero without a ramp, and return it."""
        self.state = State(REST, 0.0, 0.0)
        return REST

    def _within_speed(self, wished: Twist) -> Twist:
        most = min(self._linear.speed, self._cap)
        linear = wished.linear if most else 0.0
        angular = wished.angular if self._angular.speed else 0.0
        scale = 1.0
        if abs(linear) > most:
            scale = most / abs(linear)
        if abs(angular) * scale > self._angular.speed:
            scale = self._angular.speed / abs(angular)
        return Twist(linear * scale, angular * scale)


def _sum(a: Twist, b: Twist, share: float = 1.0) -> Twist:
    return Twist(a.linear + b.linear * share, a.angular + b.angular * share)


def _braking(axis: _Axis, stop: bool) -> float:
    return axis.stop_deceleration if stop else axis.deceleration


def _approach(
    speed: float, goal: float, slope: float, dt: float, axis: _Axis
) -> tuple[float, float]:
    # `slope` is the previous acceleration.
    if dt <= 0.0:
        return speed, slope
    # A change of direction is split at zero into deceleration and acceleration.
    target = 0.0 if speed * goal < 0 else goal
    most = axis.acceleration if abs(target) > abs(speed) else axis.deceleration
    wanted = (target - speed) / dt
    if axis.jerk and abs(target) > abs(speed):
        # A slope in the other direction is left over from braking.
        slope = slope if slope * wanted > 0 else 0.0
        step = axis.jerk * dt
        most = min(most, abs(slope) + step, _flattenable(abs(target - speed), step, dt))
        # The slope may fall faster than the jerk limit only if the speed would pass the goal
        # otherwise. It never exceeds the acceleration limit, which may have been lowered.
        most = min(axis.acceleration, max(most, abs(slope) - step))
    used = max(-most, min(most, wanted))
    # Return the goal itself if it is reached: in floating point, speed + wanted * dt may miss it.
    return (target if used == wanted else speed + used * dt), used


def _flattenable(away: float, step: float, dt: float) -> float:
    # The largest acceleration that can fall to zero by `step` in each `dt` before the goal.
    # If the acceleration starts at s and falls for n more periods, the speed changes by
    # dt ((n + 1) s - step n (n + 1) / 2).
    n = math.floor((math.sqrt(1.0 + 8.0 * away / (step * dt)) - 1.0) / 2.0)
    return (away / dt + step * n * (n + 1) / 2.0) / (n + 1)
