"""Formats messages in one line for a person, without covariances, stamps and frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from acsard.core.formatting import after_mode, printable, signed
from acsard.core.messages.schema import (
    Battery,
    BatterySummary,
    Odometry,
    Pose,
    PoseStamped,
    RobotState,
    Twist,
    TwistStamped,
)
from acsard.core.messages.state_warnings import WARNING, charge, warnings


def place(x: float, y: float, yaw: float) -> list[str]:
    """Return texts for a pose, m and rad, such as "yaw +90.0°"."""
    return [
        f"x {signed(x, 3, 8)} m",
        f"y {signed(y, 3, 8)} m",
        f"yaw {signed(math.degrees(yaw), 1, 6)}°",
    ]


def speeds(linear: float | None, angular: float | None) -> list[str]:
    """Return texts for m/s and rad/s, such as "forward +0.50 m/s"; None is unknown."""
    return [f"forward {signed(linear, 2, 5)} m/s", f"turn {signed(angular, 2, 5)} rad/s"]


def mode_and_reason(state: RobotState) -> str:
    """Return the mode, the reason, and the numbers of the causes, such as "(causes 7, 12)"."""
    return after_mode(state.mode, state.why) + cause_numbers(state)


def cause_numbers(state: RobotState) -> str:
    """Return the numbers that `acsard call clear` and `activate` take, or "" without a cause."""
    numbers = ", ".join([str(cause.number) for cause in state.causes])
    return f" (cause{'s' * (len(state.causes) > 1)} {numbers})" if numbers else ""


def short(message: object) -> str:
    """Format a message, of a type in `SHORT_TEXTS`, as one line."""
    return "  ".join(SHORT_TEXTS[type(message)](message))


def _odometry(odom: Odometry) -> list[str]:
    return [*_pose(odom.pose.pose), *_twist(odom.twist.twist)]


def _state(state: RobotState) -> list[str]:
    code = f" [{state.code}]" if state.code else ""
    why = printable(after_mode(state.mode, state.reason) + code + cause_numbers(state))
    parts = [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular), why]
    battery = charge(state.battery)
    problems = "; ".join(map(str, warnings(state)))
    return [
        *parts,
        *filter(None, (battery and f"battery {battery}", problems and f"{WARNING}: {problems}")),
    ]


def power(battery: BatterySummary) -> list[str]:
    """Return texts for voltage, current and charge, "-" if unknown."""
    return [
        f"{signed(battery.volts, 2, 6).strip().removeprefix('+')} V",
        f"{signed(battery.amps, 2, 7).strip()} A",
        f"{signed(battery.percent, 0, 4).strip().removeprefix('+')} %",
    ]


def _battery(battery: Battery) -> list[str]:
    percent = None if battery.percentage is None else battery.percentage * 100
    return power(BatterySummary(battery.voltage, percent, battery.current, "ok"))


def _pose(pose: Pose) -> list[str]:
    yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return place(pose.position.x, pose.position.y, math.remainder(yaw, math.tau))


def _twist(twist: Twist) -> list[str]:
    return speeds(twist.linear.x, twist.angular.z)


# Parts of the line, by type.
SHORT_TEXTS: dict[type, Callable[[Any], list[str]]] = {
    Odometry: _odometry,
    RobotState: _state,
    Battery: _battery,
    PoseStamped: lambda message: _pose(message.pose),
    TwistStamped: lambda message: _twist(message.twist),
}
