"""Writes messages of a robot as rows of the log that `log.py` reads.

It does not import numpy, because `acsard echo --csv` must work without it.
"""

from __future__ import annotations

import math

from acsard.core.messages.schema import Imu, JointState, Message, PoseStamped
from acsard.core.values import NS_PER_S

# The speeds of the wheels, rad/s.
FOUR = "fr", "fl", "rl", "rr"

HEADER = f"t,{','.join(FOUR)},yaw_rate,x,y,yaw"

# Zenoh keys whose messages `row()` converts to rows of a log.
KEYS = ("wheel_states", "imu", "sim/pose")


def row(message: Message, arrived_ns: int) -> str:
    """Return the CSV row of a message on one of `KEYS`. Raises `ValueError` for other messages.

    The time is the stamp of the message, or `arrived_ns` (wall clock) if it has none.
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
        raise ValueError(f"{type(message).__name__} cannot be in a log")
    stamp_ns = message.header.stamp.to_ns() or arrived_ns
    return ",".join([f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S // 1000:06d}", *cells])
