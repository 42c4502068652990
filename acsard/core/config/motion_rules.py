"""Finds contradictions between the settings that concern motion.

The robot must stop soon enough, and motion that the limits allow must not look like a fault.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.config.partial import Rule
from acsard.core.config.settings import Config

MIN_JERK = 0.01  # m/s3 or rad/s3: with less, walking pace takes more than 10 s

MAX_STOP_S = 2.0  # from full speed after a stop: no person should have to wait longer

MAX_RAMP_S = 5.0  # from full speed after the last command, while no sender controls the robot

# Speed that a sound wheel reaches for a moment, over its command.
OVERSPEED_FACTOR = 1.1

MAX_WHEEL_SPEED = 99.99  # rad/s in a line to the board


class _Reach(Struct, frozen=True):
    # The highest speeds that `[limits]` allow.
    linear: float  # m/s
    angular: float  # rad/s
    wheel: float  # rad/s


def _reach(config: Config) -> _Reach:
    drive, limits = config.drive, config.limits
    sides = (drive.left_wheel_radius_multiplier, drive.right_wheel_radius_multiplier)
    half_track = drive.wheel_separation * drive.wheel_separation_multiplier / 2
    # The limit of the wheel speed is the same for both sides. If the wheels of one side are larger,
    # the rims of that side are faster. The mean of both rim speeds bounds the linear speed. Divided
    # by half of the track, the mean bounds the turn rate.
    rim = limits.wheel_speed * drive.wheel_radius * sum(sides) / 2
    fastest_rim = limits.linear_speed + limits.angular_speed * half_track
    wished = fastest_rim / (drive.wheel_radius * min(sides))
    return _Reach(
        min(limits.linear_speed, rim),
        min(limits.angular_speed, rim / half_track),
        min(limits.wheel_speed, wished),
    )


def top_wheel_speed(config: Config) -> float:
    """Return the highest speed that `[limits]` let the daemon command to a wheel, rad/s."""
    return _reach(config).wheel


def _braking_problems(config: Config, axis: str, speed: float, unit: str) -> list[str]:
    errors = []
    softer = f"{axis}_deceleration"
    normal = getattr(config.limits, softer)
    for name, most_s in ((softer, MAX_RAMP_S), (f"{axis}_stop_deceleration", MAX_STOP_S)):
        value, least = getattr(config.limits, name), _rounded_up(speed / most_s)
        if name != softer and value < normal:
            errors.append(
                f"limits.{name} = {value:g}: lower than limits.{softer}; a stop must brake at "
                f"least as hard as the robot brakes when commands end: write "
                f"{max(normal, least):.10g} or more"
            )
        elif value < least:
            errors.append(
                f"limits.{name} = {value:g}: braking from full speed ({speed:g} {unit}) would "
                f"take {speed / value:.1f} s, but at most {most_s:g} s are allowed; "
                f"either write {least:g} or more, or lower limits.{axis}_speed"
            )
    return errors


def _jerk_problems(config: Config, name: str) -> list[str]:
    jerk = getattr(config.limits, name)
    if not 0.0 < jerk < MIN_JERK:
        return []
    return [
        f"limits.{name} = {jerk:g}: the robot would gain speed far too slowly; "
        f"write {MIN_JERK:g} or more, or 0 for no limit"
    ]


def _feedback_problems(config: Config, asked: float) -> list[str]:
    most = config.feedback.wheel_speed
    needed = min(_rounded_up(OVERSPEED_FACTOR * asked), MAX_WHEEL_SPEED)
    if most >= needed:
        return []
    return [
        f"feedback.wheel_speed = {most:g}: the limits allow commands of {asked:.1f} rad/s for a "
        f"wheel, but feedback above {most:g} counts as a fault; either write {needed:g} or "
        "more, or lower limits.wheel_speed"
    ]


def _rounded_up(value: float) -> float:
    # An error recommends the result, with three decimals: rounded down, it would be too low.
    return math.ceil(round(value * 1000, 6)) / 1000


RULES: tuple[Rule, ...] = (
    lambda config: _braking_problems(config, "linear", _reach(config).linear, "m/s"),
    lambda config: _braking_problems(config, "angular", _reach(config).angular, "rad/s"),
    lambda config: _jerk_problems(config, "linear_jerk"),
    lambda config: _jerk_problems(config, "angular_jerk"),
    lambda config: _feedback_problems(config, _reach(config).wheel),
)
