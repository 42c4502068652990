"""The rules about motion: it must end soon when it should, and must not look like a fault.

Each contradiction is a line with key, value and mend. The other rules are in `contradictions.py`.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.config.partial import Rule, told
from acsard.config.settings import Config

LEAST_JERK = 0.01
"""m/s3 or rad/s3; at less a robot takes over ten seconds to reach walking pace."""

LONGEST_STOP_S = 2.0
"""From full speed to rest by a stop: who calls for one waits no longer."""

LONGEST_RAMP_S = 5.0
"""From full speed to rest when commands end: nobody is steering any more."""

HEADROOM = 1.1
"""Times what it is told; so fast may a healthy wheel turn for a moment."""

MOST_WHEEL_SPEED = 99.99
"""rad/s; the most that a line can say."""

LONGEST_REPLY_S = 0.25
"""Between two lines; with two lost, the next still comes within the second after which the
microcontroller counts as started again."""

LINES_OF_EVIDENCE = 2
"""A fault must rest on this many lines at least, or a single lost one would be a fault."""


class _Reach(Struct, frozen=True):
    """The fastest the limits let the robot go, m/s, turn, rad/s, and any wheel turn, rad/s."""

    linear: float
    angular: float
    wheel: float


def _reach(config: Config) -> _Reach:
    drive, limits = config.drive, config.limits
    sides = (drive.left_wheel_radius_multiplier, drive.right_wheel_radius_multiplier)
    half_track = drive.wheel_separation * drive.wheel_separation_multiplier / 2
    # Where one side's wheels are larger, the fastest turn also moves forward: each side at its own
    # rim speed, so the mean of the two bounds either axis.
    rim = limits.wheel_speed * drive.wheel_radius * sum(sides) / 2
    fastest_rim = limits.linear_speed + limits.angular_speed * half_track
    wished = fastest_rim / (drive.wheel_radius * min(sides))
    return _Reach(
        min(limits.linear_speed, rim),
        min(limits.angular_speed, rim / half_track),
        min(limits.wheel_speed, wished),
    )


def _braking_problems(config: Config, axis: str, speed: float, unit: str) -> list[str]:
    found = []
    softer = f"{axis}_deceleration"
    normal = getattr(config.limits, softer)
    for name, most_s in ((softer, LONGEST_RAMP_S), (f"{axis}_stop_deceleration", LONGEST_STOP_S)):
        value, least = getattr(config.limits, name), _rounded_up(speed / most_s)
        if name != softer and value < normal:
            found.append(
                f"limits.{name} = {value:g}: lower than {softer}; a stop must not brake more "
                f"softly than a timeout: write {max(normal, least):.10g} or more"
            )
        elif value < least:
            found.append(
                f"limits.{name} = {value:g}: would take {speed / value:.1f} s from full speed "
                f"({speed:g} {unit}) to rest, and may take {most_s:g}; write {least:g} or more, "
                f"or a lower limits.{axis}_speed"
            )
    return found


def _jerk_problems(config: Config, name: str) -> list[str]:
    jerk = getattr(config.limits, name)
    if not 0.0 < jerk < LEAST_JERK:
        return []
    return [
        f"limits.{name} = {jerk:g}: the robot would take minutes to start; write "
        f"{LEAST_JERK:g} or more, or 0 for no limit"
    ]


def _feedback_problems(config: Config, asked: float) -> list[str]:
    """Lines dropped, and faults latched, while the robot does what its limits allow."""
    most = config.feedback.wheel_speed
    needed = min(_rounded_up(HEADROOM * asked), MOST_WHEEL_SPEED)
    if most >= needed:
        return []
    return [
        f"feedback.wheel_speed = {most:g}: the limits let a wheel be asked {asked:.1f} rad/s, and "
        f"lines above {most:g} are a fault; write {needed:g} or more, or a lower "
        "limits.wheel_speed"
    ]


def _reply_problems(config: Config) -> list[str]:
    """Lines so far apart that one that is lost is a fault, or a new start."""
    period, fault_s = config.mcu.reply_period, config.feedback.fault_time
    most = longest_reply(fault_s)
    if period <= most:
        return []
    way = ""
    if period <= LONGEST_REPLY_S:
        way = f", or feedback.fault_time = {_rounded_up(period * LINES_OF_EVIDENCE):g}"
    return [
        f"mcu.reply_period = {period:g}: a line that is lost would be a fault of a wheel, or look "
        f"like a new start; write {most:g} at most (the firmware must report more often){way}"
    ]


def longest_reply(fault_s: float) -> float:
    """The most that mcu.reply_period may be, s, where a fault takes `fault_s` (0 for no faults)."""
    share = math.floor(round(fault_s / LINES_OF_EVIDENCE * 1000, 6)) / 1000
    return min(LONGEST_REPLY_S, share) if fault_s else LONGEST_REPLY_S


def _rounded_up(value: float) -> float:
    """To three decimals, so that what is advised is enough."""
    return math.ceil(round(value * 1000, 6)) / 1000


RULES: tuple[Rule, ...] = (
    lambda config: _braking_problems(config, "linear", _reach(config).linear, "m/s"),
    lambda config: _braking_problems(config, "angular", _reach(config).angular, "rad/s"),
    lambda config: _jerk_problems(config, "linear_jerk"),
    lambda config: _jerk_problems(config, "angular_jerk"),
    lambda config: _feedback_problems(config, _reach(config).wheel),
    _reply_problems,
)


def problems(config: Config) -> list[str]:
    """What cannot be: a line each."""
    return told(RULES, config)
