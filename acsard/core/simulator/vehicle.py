"""Simulates four motors with lag on a moving base: the motion that encoders and the floor see.

Motors follow their set points as first-order systems. The base moves by the wheels' real speeds,
real radii and real effective track, which `[sim]` can set apart from the configured ones. With
`turn_slip` skidding wheels turn the base less than they roll; with `load` the motors deliver less
than their set points. A person who pushes the robot is stronger than the motors. Wheels are in
`values.WHEELS` order.

Let w be the turn rate in rad/s that the wheels would give at track_multiplier times the configured
effective track L, and k = track_rate_dependence. The base turns at

    w / (1 + 2 k |w| / (1 + |w|))

The effective track is therefore L x track_multiplier at creeping speed, (1 + k) times that at 1
rad/s, and it stays bounded.
"""

from __future__ import annotations

import math

from acsard.core.config.settings import DriveConfig, SimConfig
from acsard.core.motion.path import arc
from acsard.core.simulator.noise import uniform
from acsard.core.values import Pose

GRIP_S = 0.25
"""Seconds for which the wheels keep their present grip of the floor."""

HANDS_S = 0.1
"""Seconds in which a person brings the robot to speed, as a time constant like a motor's."""


class Vehicle:
    """The true state of the robot: speeds in rad/s, angles in rad, pose in m and rad."""

    def __init__(self, sim: SimConfig, drive: DriveConfig) -> None:
        self._lag = sim.motor_time_constant
        left, right = sim.left_radius_multiplier, sim.right_radius_multiplier
        self._left_radius = drive.wheel_radius * drive.left_wheel_radius_multiplier * left
        self._right_radius = drive.wheel_radius * drive.right_wheel_radius_multiplier * right
        track = drive.wheel_separation * drive.wheel_separation_multiplier
        self._track = track * sim.track_multiplier
        self._rate_dependence = sim.track_rate_dependence
        self._floor, self._seed, self._time = sim.turn_slip, sim.seed, 0.0
        self.set_points = [0.0] * 4
        self.speeds = [0.0] * 4
        self.angles = [0.0] * 4
        self.pose = Pose()
        """The true pose of base_link relative to its start."""
        self.turned = 0.0
        """Angle in rad to the left since the start, with whole turns counted."""
        self.turn_slip = 0.0
        """Fraction of every turn that is lost to skidding, 0 to 1."""
        self.load = 0.0
        """Fraction by which the motors fall short of every set point, 0 to 1."""

    def advance(self, dt: float, push: float | None = None) -> None:
        """Let `dt` s pass under the present set points, or pushed by hand at `push` m/s."""
        if dt <= 0.0:
            return
        if push is None and not (any(self.set_points) or any(self.speeds)):
            self._time += dt
            return
        grip = self._grip()
        self._time += dt
        if push is not None:
            right, left = push / self._right_radius, push / self._left_radius
            goals, lag = [right, left, left, right], HANDS_S
        else:
            given = 1.0 - self.load
            goals, lag = [point * given for point in self.set_points], self._lag
        if not (any(goals) or any(self.speeds)):
            return
        rest = math.exp(-dt / lag) if lag else 0.0
        gone, turned, speeds, angles = 1.0 - rest, [0.0] * 4, self.speeds, self.angles
        for i, goal in enumerate(goals):
            error = speeds[i] - goal
            # This is the integral of an exponential approach, so the path does not depend on dt.
            angle = turned[i] = goal * dt + error * lag * gone
            speed = goal + error * rest
            speeds[i] = speed if abs(speed) > 1e-9 else 0.0
            angles[i] += angle
        left = self._left_radius * (turned[1] + turned[2]) / 2
        right = self._right_radius * (turned[0] + turned[3]) / 2
        turn = (right - left) / self._track
        rate = abs(turn) / dt
        turn *= grip / (1.0 + 2.0 * self._rate_dependence * rate / (1.0 + rate))
        self.turned += turn
        self.pose = arc(self.pose, (left + right) / 2, turn)

    def _grip(self) -> float:
        """Return the fraction of a turn that the floor does not take now."""
        kept = 1.0 - self.turn_slip
        if self._floor:
            kept *= 1.0 - self._floor * uniform(self._seed, int(self._time / GRIP_S))
        return kept
