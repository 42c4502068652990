"""Makes the messages that the simulator publishes about the true motion of its robot.

Each message is made from an `Observation` of the robot.
"""

from __future__ import annotations

from acsard.core.messages.report import from_yaw
from acsard.core.messages.schema import Header, Imu, Pose, PoseStamped, Quaternion, Time, Vector3
from acsard.core.simulator.simulated_robot import Observation

FRAME = "sim"
"""Frame of the true pose. Its origin is the robot's pose at the start of the simulator. No
transform connects it with `odom`, so no program can mistake the true pose for odometry."""


def true_pose(observation: Observation, wall_ns: int) -> PoseStamped:
    """Return the true pose of base_link in the frame `sim`.

    `wall_ns` is the stamp of the message, ns since 1970.
    """
    pose = observation.pose
    where = Pose(Vector3(pose.x, pose.y), from_yaw(pose.yaw))
    return PoseStamped(Header(Time.from_ns(wall_ns), FRAME), where)


def turn_rate(observation: Observation, frame: str, deviation: float, wall_ns: int) -> Imu:
    """Return the turn rate that the gyro measured, as an Imu message without other measurements.

    Args:
        observation: the observation of the robot.
        frame: the frame id of the gyro.
        deviation: the standard deviation of the gyro's noise, rad/s.
        wall_ns: the stamp of the message, ns since 1970.
    """
    unknown, variance = [-1.0] + [0.0] * 8, deviation * deviation
    known = [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]
    rate = Vector3(z=observation.gyro)
    header = Header(Time.from_ns(wall_ns), frame)
    return Imu(header, Quaternion(), unknown, rate, known, Vector3(), unknown)
