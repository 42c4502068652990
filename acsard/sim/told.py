"""A `Sight` of the simulated robot -> the messages that tell it on the bus."""

from __future__ import annotations

from acsard.messages.report import from_yaw
from acsard.messages.schema import Header, Imu, Pose, PoseStamped, Quaternion, Time, Vector3
from acsard.sim.watched import Sight

FRAME = "sim"
"""Where the robot began, in no tree of transforms: truth is not to be taken for `odom`."""


def true_pose(sight: Sight, wall_ns: int) -> PoseStamped:
    """Where base_link truly was at `wall_ns`, from where it began: m in the frame `sim`."""
    pose = sight.pose
    where = Pose(Vector3(pose.x, pose.y), from_yaw(pose.yaw))
    return PoseStamped(Header(Time.from_ns(wall_ns), FRAME), where)


def turn_rate(sight: Sight, frame: str, deviation: float) -> Imu:
    """What the gyro says, with the standard deviation of its noise, rad/s.

    It has no clock of its own: the message has no stamp, and counts when it comes.
    """
    unknown, variance = [-1.0] + [0.0] * 8, deviation * deviation
    known = [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]
    rate = Vector3(z=sight.gyro)
    return Imu(Header(Time(), frame), Quaternion(), unknown, rate, known, Vector3(), unknown)
