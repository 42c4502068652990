"""The odometry of a robot with its checks and its configuration, as the robot uses them."""

from __future__ import annotations

import math

from acsard.core.config.settings import DriveConfig, OdometryConfig, WheelMap
from acsard.core.link.feedback import Line
from acsard.core.motion.agreement import claims
from acsard.core.motion.consistency import ConsistencyChecks
from acsard.core.motion.gyro import Gyro
from acsard.core.motion.kinematics import Kinematics, on_arc
from acsard.core.motion.odometry import Odometry
from acsard.core.motion.uncertainty import ErrorModel
from acsard.core.values import Estimate, Pose, WheelSpeeds
from tests.wheels import FOUR, STEADY

MEASURED = OdometryConfig(
    wheel_separation_multiplier_std=0.0, wheel_radius_ratio_std=0.0, distance_scale_std=0.0
)
"""The default noise of a robot whose track and wheels are known exactly."""


class Odometer:
    def __init__(
        self,
        odometry: OdometryConfig = MEASURED,
        counts: int = 0,
        drive: DriveConfig = DriveConfig(),  # noqa: B008
        wheels: WheelMap = FOUR,
    ) -> None:
        kinematics, limits = Kinematics(drive), STEADY
        self.model = ErrorModel(odometry, kinematics, counts, limits, names=wheels.names)
        self.checks = ConsistencyChecks.initial(self.model)
        self.odometry = Odometry.initial(self.model)
        self._claims = claims(odometry, kinematics, counts)

    @property
    def pose(self) -> Pose:
        return self.odometry.pose

    def use(self, gyro: Gyro) -> None:
        """Use this gyro, whether one is configured or not."""
        self.checks.gyro, self.model.claims = gyro, self._claims

    def fold(self, line: Line, commanded: WheelSpeeds | None = None) -> Estimate:
        if commanded is not None:
            self.checks.wheels.commanded = commanded
        return self.odometry.fold(line, self.checks, self.model)

    def skip(self, line: Line) -> None:
        self.odometry.skipped.add(line)

    def set_pose(self, pose: Pose, at_ns: int = 1) -> None:
        self.odometry.set_pose(pose, self.model, at_ns)
        self.checks.gyro.forget_doubt()


def arc(pose: Pose, distance: float, turn: float) -> Pose:
    """Return the pose at the end of an arc."""
    yaw = math.remainder(pose.yaw, math.tau)
    dx, dy, yaw = on_arc(yaw, distance, turn)
    return Pose(pose.x + dx, pose.y + dy, yaw)
