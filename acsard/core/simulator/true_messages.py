"""Makes the messages that the simulator publishes about the true motion of its robot."""

from __future__ import annotations

from acsard.core.messages.report import from_yaw
from acsard.core.messages.schema import Header, Imu, Pose, PoseStamped, Time, Vector3
from acsard.core.simulator.simulated_robot import Observation
from acsard.core.values import WallNs

# Its origin is the pose at the start. No transform connects it with `odom`, so no program can
# mistake the true pose for odometry.
FRAME = "sim"


def true_pose(observation: Observation, wall_ns: WallNs) -> PoseStamped:
    """Return the true pose of base_link in the frame `sim`."""
    pose = observation.pose
    where = Pose(Vector3(pose.x, pose.y), from_yaw(pose.yaw))
    return PoseStamped(Header(Time.from_ns(wall_ns), FRAME), where)


def turn_rate(observation: Observation, frame: str, wall_ns: WallNs) -> Imu:
    """Return the gyro's turn rate as an Imu message."""
    unmeasured = [-1.0] + [0.0] * 8
    return Imu(
        header=Header(Time.from_ns(wall_ns), frame),
        orientation_covariance=unmeasured,
        angular_velocity=Vector3(z=observation.gyro),
        linear_acceleration_covariance=unmeasured,
    )
