"""Simulates the robot: motors with lag, and the motion of the base on the floor.

A motor is a first-order system. The true track, which `[sim]` can make different from `[drive]`,
gives the motion.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import DriveConfig, SimConfig
from acsard.core.motion.kinematics import on_arc
from acsard.core.values import Pose, Rad, RadPerS, Seconds

PUSH_TIME_CONSTANT_S = 0.1  # of the wheel speeds, towards a person's who pushes the robot


def approach(speed: RadPerS, goal: RadPerS, dt: Seconds, lag: Seconds) -> tuple[RadPerS, Rad]:
    """Return the speed of a motor after `dt`, and the angle that its wheel turns meanwhile.

    The angle is the exact integral of the exponential approach to `goal`, so the path does not
    depend on the size of `dt`.
    """
    rest = math.exp(-dt / lag) if lag else 0.0
    error = speed - goal
    angle = goal * dt + error * lag * (1.0 - rest)
    speed = goal + error * rest
    return speed if abs(speed) > 1e-9 else 0.0, angle


def whole_counts(angle: Rad, per_turn: int) -> int:
    """Return what an encoder has counted whose 0 rad is in the middle of a count."""
    return math.floor(angle / math.tau * per_turn + 0.5)


class Vehicle:
    """The true state: wheel speeds in rad/s and angles in rad, in `WHEELS` order, and the pose."""

    def __init__(self, sim: SimConfig, drive: DriveConfig) -> None:
        self._lag = sim.motor_time_constant
        self._left_radius = drive.wheel_radius * drive.left_wheel_radius_multiplier
        self._right_radius = drive.wheel_radius * drive.right_wheel_radius_multiplier
        track = drive.wheel_separation * drive.wheel_separation_multiplier
        self._track = track * sim.track_multiplier
        self.set_points = [0.0] * 4
        self.speeds = [0.0] * 4
        self.angles = [0.0] * 4
        self.pose = Pose()  # of base_link, relative to its start
        self.turned = 0.0  # rad to the left, beyond pi
        self.turn_slip = 0.0  # fraction of each turn that skidding loses
        self.load = 0.0  # 0 to 1; the motors reach 1 - `load` of each set point

    def advance(self, dt: float, push: float | None = None) -> None:
        """Move the robot for `dt` s, by its set points, or at `push` m/s by a person."""
        if dt <= 0.0:
            return
        if push is None and not (any(self.set_points) or any(self.speeds)):
            return
        if push is not None:
            right, left = push / self._right_radius, push / self._left_radius
            goals, lag = [right, left, left, right], PUSH_TIME_CONSTANT_S
        else:
            fraction = 1.0 - self.load
            goals, lag = [point * fraction for point in self.set_points], self._lag
        if not (any(goals) or any(self.speeds)):
            return
        turned, speeds, angles = [0.0] * 4, self.speeds, self.angles
        for i, goal in enumerate(goals):
            speeds[i], turned[i] = approach(speeds[i], goal, dt, lag)
            angles[i] += turned[i]
        left = self._left_radius * (turned[1] + turned[2]) / 2
        right = self._right_radius * (turned[0] + turned[3]) / 2
        turn = (right - left) / self._track * (1.0 - self.turn_slip)
        self.turned += turn
        dx, dy, yaw = on_arc(self.pose.yaw, (left + right) / 2, turn)
        self.pose = Pose(self.pose.x + dx, self.pose.y + dy, yaw)
