"""Adds arcs to a pose. Rounding errors do not build up, even over millions of arcs.

An arc of length d and angle a from the heading yaw has a chord of length d sin(a / 2) / (a / 2) in
the direction yaw + a / 2. The rounding error of each sum is added to the next one (Kahan, Further
Remarks on Reducing Truncation Errors, 1965), and wrapping subtracts the exact 2 pi (`TAU_REST`).
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.values import Metres, Pose, Rad

TAU_REST = 2.4492935982947064e-16  # 2 pi minus `math.tau`


class Path(Struct):
    """The pose at the end of a path of arcs."""

    pose: Pose = Pose()  # of base_link in odom, yaw within [-pi, pi]
    # Rounding errors of the pose.
    x_rest: Metres = 0.0
    y_rest: Metres = 0.0
    yaw_rest: Rad = 0.0

    def set(self, pose: Pose) -> None:
        self.pose = Pose(pose.x, pose.y, math.remainder(pose.yaw, math.tau))
        self.x_rest = self.y_rest = self.yaw_rest = 0.0

    def advance(self, distance: Metres, turn: Rad) -> tuple[float, float, float]:
        """Add an arc; return x and y, m, and the direction, rad, of its chord in odom."""
        half, pose = turn / 2, self.pose
        # sin(h)/h is accurate in doubles down to tiny h. Only h = 0 needs its limit.
        chord = distance * (math.sin(half) / half if half else 1.0)
        heading = pose.yaw + half
        dx, dy = chord * math.cos(heading), chord * math.sin(heading)
        x, self.x_rest = plus(pose.x, dx + self.x_rest)
        y, self.y_rest = plus(pose.y, dy + self.y_rest)
        self.pose = Pose(x, y, self._turned(turn))
        return dx, dy, heading

    def turn(self, turn: Rad) -> None:
        self.pose = Pose(self.pose.x, self.pose.y, self._turned(turn))

    def _turned(self, turn: Rad) -> Rad:
        wrapped, rest = _wrapped(self.pose.yaw, turn)
        yaw, self.yaw_rest = plus(wrapped, rest + self.yaw_rest)
        return yaw


def plus(a: float, b: float) -> tuple[float, float]:
    """Return the double nearest to a + b, and its exact rounding error (Knuth's TwoSum)."""
    total = a + b
    of_b = total - a
    return total, (a - (total - of_b)) + (b - of_b)


def arc(pose: Pose, distance: Metres, turn: Rad) -> Pose:
    half, yaw = turn / 2, math.remainder(pose.yaw, math.tau)
    chord = distance * (math.sin(half) / half if half else 1.0)
    heading = yaw + half
    wrapped, rest = _wrapped(yaw, turn)
    return Pose(
        pose.x + chord * math.cos(heading), pose.y + chord * math.sin(heading), wrapped + rest
    )


def _wrapped(yaw: float, turn: float) -> tuple[float, float]:
    # yaw + turn within [-pi, pi], and its rounding error
    total, rest = plus(yaw, turn)
    wrapped = math.remainder(total, math.tau)
    if wrapped != total:
        rest -= round((total - wrapped) / math.tau) * TAU_REST
    return wrapped, rest
