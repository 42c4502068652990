"""The path of the robot in the last minutes, thinned, for a newly opened page.

This module is pure.
"""

from __future__ import annotations

import math
from collections import deque

from acsard.values import NS_PER_S

LASTS_NS = 600 * NS_PER_S

POINTS = 5000

STEP_M = 0.02
"""Minimum distance of two points; a nearer point is not stored."""

JUMP_M = 1.0
"""A longer step than any robot moves between two states, so the pose was set and the path
restarts."""


class Trail:
    """The points of the path, m in the odom frame, oldest first."""

    def __init__(self) -> None:
        self._points: deque[tuple[int, float, float]] = deque(maxlen=POINTS)

    def add(self, at_ns: int, x: float, y: float) -> None:
        """Append a position and drop points older than `LASTS_NS`."""
        while self._points and at_ns - self._points[0][0] > LASTS_NS:
            self._points.popleft()
        if self._points:
            way = math.hypot(x - self._points[-1][1], y - self._points[-1][2])
            if way < STEP_M:
                return
            if way > JUMP_M:
                self._points.clear()
        self._points.append((at_ns, x, y))

    def points(self) -> list[tuple[float, float]]:
        """Return the points, rounded to mm."""
        return [(round(x, 3), round(y, 3)) for _, x, y in self._points]
