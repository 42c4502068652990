"""Formats the pose and the motion of the robot in one line for a person; pure.

Covariances, stamps and frames are left out: programs read them in the JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from acsard.core.formatting import printable, signed
from acsard.core.messages.schema import Odometry, Pose, PoseStamped, RobotState, Twist, TwistStamped


def place(x: float, y: float, yaw: float) -> list[str]:
    """Format a pose with units: x and y in m, yaw in degrees. The arguments are in m and rad."""
    return [
        f"x {signed(x, 3, 8)} m",
        f"y {signed(y, 3, 8)} m",
        f"yaw {signed(math.degrees(yaw), 1, 6)}°",
    ]


def speeds(linear: float | None, angular: float | None) -> list[str]:
    """Format a twist with units: m/s and rad/s, or "-" for an unknown speed."""
    return [f"forward {signed(linear, 2, 5)} m/s", f"turn {signed(angular, 2, 5)} rad/s"]


def short(message: object) -> str:
    """Format a message in one line; its type must be in `SHORT`."""
    return "  ".join(SHORT[type(message)](message))


def _odometry(odom: Odometry) -> list[str]:
    return [*_pose(odom.pose.pose), *_twist(odom.twist.twist)]


def _state(state: RobotState) -> list[str]:
    why = state.reason.removeprefix(f"{state.mode}: ")
    told = printable(f"{state.mode}: {why}")
    return [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular), told]


def _pose(pose: Pose) -> list[str]:
    yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return place(pose.position.x, pose.position.y, math.remainder(yaw, math.tau))


def _twist(twist: Twist) -> list[str]:
    return speeds(twist.linear.x, twist.angular.z)


SHORT: dict[type, Callable[[Any], list[str]]] = {
    Odometry: _odometry,
    RobotState: _state,
    PoseStamped: lambda message: _pose(message.pose),
    TwistStamped: lambda message: _twist(message.twist),
}
"""Types with a short form, and the function that makes it."""
