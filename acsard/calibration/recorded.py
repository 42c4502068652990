"""Converts bus messages to rows of a log that `table.py` reads."""

from __future__ import annotations

import math

from acsard.calibration.table import FOUR
from acsard.messages.schema import Imu, JointState, Message, PoseStamped
from acsard.values import NS_PER_S

HEADER = f"t,{','.join(FOUR)},yaw_rate,x,y,yaw"

KEYS = ("wheel_states", "imu", "sim/pose")
"""Keys that a log can contain. Wheel speeds are in the order in which they are published."""


def row(message: Message, arrived_ns: int) -> str:
    """Return the row of one message of `KEYS`. Raises `ValueError` for any other message.

    `arrived_ns` is the wall-clock time that a message without a stamp gets.
    """
    if isinstance(message, JointState) and len(message.velocity) == len(FOUR):
        cells = [*(f"{speed:.6g}" for speed in message.velocity), "", "", "", ""]
    elif isinstance(message, Imu):
        cells = ["", "", "", "", f"{message.angular_velocity.z:.6g}", "", "", ""]
    elif isinstance(message, PoseStamped):
        where, turn = message.pose.position, message.pose.orientation
        yaw = 2 * math.atan2(turn.z, turn.w)
        cells = ["", "", "", "", "", f"{where.x:.4f}", f"{where.y:.4f}", f"{yaw:.5f}"]
    else:
        raise ValueError(f"{type(message).__name__} is no part of a log")
    stamp_ns = message.header.stamp.to_ns() or arrived_ns
    return ",".join([f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S // 1000:06d}", *cells])
