"""Converts a `Sight` of the simulated robot into the messages that are published."""

from __future__ import annotations

from acsard.core.messages.report import from_yaw
from acsard.core.messages.schema import Header, Imu, Pose, PoseStamped, Quaternion, Time, Vector3
from acsard.core.simulator.simulated_robot import Sight

FRAME = "sim"
"""Frame of the robot's start. It is in no tree of transforms, so nobody takes the truth for
`odom`."""


def true_pose(sight: Sight, wall_ns: int) -> PoseStamped:
    """Return the true pose of base_link at `wall_ns`, m from its start, in the frame `sim`."""
    pose = sight.pose
    where = Pose(Vector3(pose.x, pose.y), from_yaw(pose.yaw))
    return PoseStamped(Header(Time.from_ns(wall_ns), FRAME), where)


def turn_rate(sight: Sight, frame: str, deviation: float, wall_ns: int) -> Imu:
    """Return the gyro's measurement at `wall_ns`, rad/s.

    `deviation` is the standard deviation of its noise, rad/s.
    """
    unknown, variance = [-1.0] + [0.0] * 8, deviation * deviation
    known = [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]
    rate = Vector3(z=sight.gyro)
    header = Header(Time.from_ns(wall_ns), frame)
    return Imu(header, Quaternion(), unknown, rate, known, Vector3(), unknown)
