"""Compares a gyro with the wheels: learns the ratio of their turns, and finds contradictions.

A least-squares fit of means over `BLOCK_S` finds a in g = a w, with the rates g of the gyro and w
of the wheels, rad/s. It forgets only while the robot turns. A delay is the matter of the gyro's
driver, and is 0 here.
"""

from __future__ import annotations

import math
from collections import deque

BLOCK_S = 0.1  # of means: one line has too few counts for a precise rate

MIN_TURN_RATE = 0.05  # rad/s by the wheels

FORGETTING_FACTOR = 0.995  # of earlier blocks with each block of turning: 200 blocks, or 20 s

# Standard deviations of the ratio: before any data, and the least, because floor and turn rate
# change it.
INITIAL_RATIO_STD, MIN_RATIO_STD = 0.5, 0.1

# Standard deviation of a block's mean, rad/s, plus this share of it.
BLOCK_NOISE, BLOCK_SHARE = 0.01, 0.03

MAX_DELAY_S = 0.05  # a gyro with this delay does not contradict the wheels

WINDOW_S = 0.2  # for the comparison of turns

WINDOW_STD = 0.015  # rad over `WINDOW_S` without slip, by encoder counts and vibration

MAX_DEVIATIONS = 3.0  # more over `WINDOW_S` is a contradiction


class Match:
    """Learns the ratio of the gyro's turns to the wheels' turns."""

    def __init__(self) -> None:
        # The sums begin as the ratio 1 with the standard deviation `INITIAL_RATIO_STD`.
        self._ww, self._wg = 1.0 / INITIAL_RATIO_STD**2, 1.0 / INITIAL_RATIO_STD**2
        self.ratio = 1.0  # the gyro's turn divided by the wheels' turn
        self.deviation = INITIAL_RATIO_STD  # assumed standard deviation of `ratio`
        self.blocks = 0.0  # in which the robot turned; old ones count less
        self._wheels = self._gyro = self._time = 0.0
        self._window: deque[tuple[float, float, float]] = deque()
        self._sums = [0.0, 0.0, 0.0]

    def add(self, wheels: float, gyro: float, dt: float, slips: bool) -> None:
        """Add a line of `dt` s, rad by wheels and gyro; a block that slips teaches nothing."""
        self._slide(wheels, gyro, dt)
        self._wheels += wheels
        self._gyro += gyro
        self._time += dt
        if self._time >= BLOCK_S * 0.95:
            if not slips:
                self._learn(self._wheels / self._time, self._gyro / self._time)
            self._wheels = self._gyro = self._time = 0.0

    def contradiction(self, variance: float) -> bool:
        """Return whether the turns over `WINDOW_S` are contradictory (gyro's variance, rad2)."""
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
