"""The way of the robot in the last minutes, thinned, for a page that has just been opened; pure."""

from __future__ import annotations

import math
from collections import deque

from acsard.values import NS_PER_S

LASTS_NS = 600 * NS_PER_S

POINTS = 5000

STEP_M = 0.02
"""Nearer than this to the last point is no new one."""

JUMP_M = 1.0
"""Further than any robot goes between two states: the pose was set."""


class Trail:
    """Points in the odom frame, m, oldest first."""

    def __init__(self) -> None:
        self._points: deque[tuple[int, float, float]] = deque(maxlen=POINTS)

    def add(self, at_ns: int, x: float, y: float) -> None:
        """The robot is here."""
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
        """To mm."""
        return [(round(x, 3), round(y, 3)) for _, x, y in self._points]
