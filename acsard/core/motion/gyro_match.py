"""Compares a gyro with the wheels: learns the ratio of their turns, and finds contradictions.

Let w be the turn rate according to the wheels and g that of the gyro, rad/s, as means over blocks
of a tenth of a second. A least-squares fit finds the ratio a in g = a w. It forgets old data only
while the robot turns. A delay of the gyro is the matter of its driver, and counts as 0 here.
"""

from __future__ import annotations

import math
from collections import deque

BLOCK_S = 0.1
"""Duration of a block, over which the turn rates are averaged, s. A single feedback line has too
few encoder counts for a precise rate."""

MIN_TURN_RATE = 0.05
"""Smallest turn rate according to the wheels, rad/s, at which the robot counts as turning."""

FORGETTING_FACTOR = 0.995
"""Factor that reduces the weight of all earlier blocks (`BLOCK_S`) with each block in which the
robot turns. The fit thus remembers 200 blocks (20 s of turning)."""

INITIAL_RATIO_STD, MIN_RATIO_STD = 0.5, 0.1
"""Standard deviations of the ratio of the gyro's turn to the wheels' turn. `INITIAL_RATIO_STD` is
the value that is assumed before any data. `MIN_RATIO_STD` is the smallest value that is assumed,
because floor and turn rate change the ratio."""

BLOCK_NOISE, BLOCK_SHARE = 0.01, 0.03
"""The mean turn rate over a block (`BLOCK_S`) has a standard deviation of `BLOCK_NOISE` rad/s plus
`BLOCK_SHARE` times the rate."""

MAX_DELAY_S = 0.05
"""Delay of a gyro that is no contradiction between gyro and wheels, s."""

WINDOW_S = 0.2
"""Time over which the turns of gyro and wheels are compared to find a contradiction, s."""

WINDOW_STD = 0.015
"""Standard deviation, rad, of the difference between the turns of gyro and wheels over `WINDOW_S`
without slip. Encoder counts and vibration cause it."""

MAX_DEVIATIONS = 3.0
"""Number of standard deviations by which the turns of gyro and wheels over `WINDOW_S` may differ.
If they differ by more, gyro and wheels contradict each other."""


class Match:
    """Learns the ratio of the gyro's turns to the wheels' turns."""

    def __init__(self) -> None:
        # Sums of the least-squares fit. Their initial values stand for the ratio 1 with the
        # standard deviation `INITIAL_RATIO_STD`.
        self._ww, self._wg = 1.0 / INITIAL_RATIO_STD**2, 1.0 / INITIAL_RATIO_STD**2
        self.ratio = 1.0  # the gyro's turn divided by the wheels' turn
        self.deviation = INITIAL_RATIO_STD  # assumed standard deviation of `ratio`
        self.blocks = 0.0  # in which the robot turned; old ones count less
        self._wheels = self._gyro = self._time = 0.0
        self._window: deque[tuple[float, float, float]] = deque()
        self._sums = [0.0, 0.0, 0.0]

    def add(self, wheels: float, gyro: float, dt: float, slips: bool) -> None:
        """Add a feedback line. When a block is complete, learn from it.

        `wheels` and `gyro` are the turns of the robot in the last `dt` s according to wheels and
        gyro, rad. If `slips` is true in the last line of a block, the wheels slip, and nothing is
        learned from this block.
        """
        self._slide(wheels, gyro, dt)
        self._wheels += wheels
        self._gyro += gyro
        self._time += dt
        if self._time >= BLOCK_S * 0.95:
            if not slips:
                self._learn(self._wheels / self._time, self._gyro / self._time)
            self._wheels = self._gyro = self._time = 0.0

    def contradiction(self, variance: float) -> bool:
        """Return whether the turns of gyro and wheels in the last `WINDOW_S` s are contradictory.

        `variance` is the variance of the gyro's turn over this time, rad2.
        """
        wheels, gyro, time = self._sums
        if time < WINDOW_S * 0.95:
            return False
        first, last = self._window[0], self._window[-1]
        lag = MAX_DELAY_S * self.ratio * (last[0] / last[2] - first[0] / first[2])
        uncertain = (self.deviation * wheels) ** 2 + lag * lag + variance + WINDOW_STD**2
        return (gyro - self.ratio * wheels) ** 2 > MAX_DEVIATIONS**2 * uncertain

    def _slide(self, wheels: float, gyro: float, dt: float) -> None:
        window, sums = self._window, self._sums
        window.append((wheels, gyro, dt))
        sums[0] += wheels
        sums[1] += gyro
        sums[2] += dt
        while sums[2] - window[0][2] > WINDOW_S * 0.95:
            old = window.popleft()
            sums[0] -= old[0]
            sums[1] -= old[1]
            sums[2] -= old[2]

    def _learn(self, wheels: float, gyro: float) -> None:
        if abs(wheels) < MIN_TURN_RATE:
            return
        weight = 1.0 / (BLOCK_NOISE + BLOCK_SHARE * abs(wheels)) ** 2
        self._ww = FORGETTING_FACTOR * self._ww + weight * wheels * wheels
        self._wg = FORGETTING_FACTOR * self._wg + weight * wheels * gyro
        self.blocks = FORGETTING_FACTOR * self.blocks + 1.0
        self.ratio = self._wg / self._ww
        self.deviation = max(MIN_RATIO_STD, INITIAL_RATIO_STD / math.sqrt(1.0 + self.blocks))
