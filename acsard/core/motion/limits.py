"""Limits a requested twist: speed, wheel saturation, acceleration, deceleration and jerk.

`follow` moves both axes separately towards a command. `coast` reduces them in proportion, or a
wheel could speed up (rule 2 of `acsard/README.md`). Jerk is limited only for speeding up, because
comfort must not delay braking.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import LimitsConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import AT_REST, Motion, Twist


def follow(
    motion: Motion,
    wished: Twist,
    dt: float,
    limits: LimitsConfig,
    kinematics: Kinematics,
    cap: float = math.inf,
) -> Motion:
    """Return the motion `dt` s later, towards a finite twist; `cap` also limits the speed.

    A robot that is faster than the limits slows down as configured, but a lower wheel speed has
    no ramp, so lower it only at rest.
    """
    now = motion.twist
    goal = kinematics.saturate(_within_speed(wished, limits, cap), limits.wheel_speed)
    if now == goal and motion.linear_slope == motion.angular_slope == 0.0:
        return motion  # as in most steps
    linear, linear_slope = _approach(
        now.linear,
        goal.linear,
        motion.linear_slope,
        dt,
        limits.linear_acceleration,
        limits.linear_deceleration,
        limits.linear_jerk,
    )
    angular, angular_slope = _approach(
        now.angular,
        goal.angular,
        motion.angular_slope,
        dt,
        limits.angular_acceleration,
        limits.angular_deceleration,
        limits.angular_jerk,
    )
    twist = _fitted(now, Twist(linear, angular), kinematics, limits.wheel_speed)
    return Motion(twist, linear_slope, angular_slope)


def coast(motion: Motion, dt: float, limits: LimitsConfig, stop: bool = False) -> Motion:
    """Return the motion `dt` s later, both speeds reduced towards rest in proportion.

    `stop` uses `*_stop_deceleration`. A negative `dt` is 0, and cannot speed up the robot.
    """
    dt, twist = max(0.0, dt), motion.twist
    if stop:
        linear, angular = limits.linear_stop_deceleration, limits.angular_stop_deceleration
    else:
        linear, angular = limits.linear_deceleration, limits.angular_deceleration
    seconds = max(abs(twist.linear) / linear, abs(twist.angular) / angular)
    share = 1.0 - dt / seconds if seconds > dt else 0.0
    return Motion(Twist(twist.linear * share, twist.angular * share)) if share else AT_REST


def _within_speed(wished: Twist, limits: LimitsConfig, cap: float) -> Twist:
    most, most_angular = min(limits.linear_speed, cap), limits.angular_speed
    linear = wished.linear if most else 0.0
    angular = wished.angular if most_angular else 0.0
    scale = 1.0
    if abs(linear) > most:
        scale = most / abs(linear)
    if abs(angular) * scale > most_angular:
        scale = most_angular / abs(angular)
    return Twist(linear * scale, angular * scale)


def _fitted(now: Twist, twist: Twist, kinematics: Kinematics, most: float) -> Twist:
    if kinematics.fits(twist, most):
        return twist
    # On the way, both axes together may need a faster wheel than at the start or at the goal. So
    # one axis changes as far as it may, and the other one as far as the wheels allow. An axis that
    # slows down goes first, because braking must not wait.
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


def _sum(a: Twist, b: Twist, share: float = 1.0) -> Twist:
    return Twist(a.linear + b.linear * share, a.angular + b.angular * share)


def _approach(
    speed: float,
    goal: float,
    slope: float,
    dt: float,
    acceleration: float,
    deceleration: float,
    jerk: float,
) -> tuple[float, float]:
    # `slope` is the previous acceleration.
    if dt <= 0.0:
        return speed, slope
    # A change of direction is split at zero into deceleration and acceleration.
    target = 0.0 if speed * goal < 0 else goal
    most = acceleration if abs(target) > abs(speed) else deceleration
    wanted = (target - speed) / dt
    if jerk and abs(target) > abs(speed):
        # A slope in the other direction is left over from braking.
        slope = slope if slope * wanted > 0 else 0.0
        step = jerk * dt
        most = min(most, abs(slope) + step, _flattenable(abs(target - speed), step, dt))
        # The slope may fall faster than the jerk limit only if the speed would pass the goal
        # otherwise. It never exceeds the acceleration limit, which may have been lowered.
        most = min(acceleration, max(most, abs(slope) - step))
    used = max(-most, min(most, wanted))
    # Return the goal itself if it is reached: in floating point, speed + wanted * dt may miss it.
    return (target if used == wanted else speed + used * dt), used


def _flattenable(away: float, step: float, dt: float) -> float:
    # The largest acceleration that can fall to zero by `step` in each `dt` before the goal.
    # If the acceleration starts at s and falls for n more periods, the speed changes by
    # dt ((n + 1) s - step n (n + 1) / 2).
    n = math.floor((math.sqrt(1.0 + 8.0 * away / (step * dt)) - 1.0) / 2.0)
    return (away / dt + step * n * (n + 1) / 2.0) / (n + 1)
