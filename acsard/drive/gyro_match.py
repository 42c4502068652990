"""Gyro and wheels compared: how far the robot turns per turn of its wheels, and when that is told.

With w(t) the wheels' turn rate and g(t) the gyro's, g(t) = a w(t - T): a is the configured
effective track over the true one, T how late the gyro tells. For small T that is
g = a w - a T dw/dt, whose coefficients least squares finds from means over a tenth of a second;
what it forgets, it forgets while the robot turns. T is where the two rates correlate best.
"""

from __future__ import annotations

import math
from collections import deque

BLOCK_S = 0.1
"""s over which rates are compared: encoder counts are coarse over a line."""

LEAST_RATE = 0.05
"""rad/s; slower blocks tell nothing of the ratio."""

LEAST_CHANGE = 0.3
"""rad/s2; without it a block tells nothing of the delay."""

MEMORY = 0.995
"""What is left of a block after the next: the last 20 s of turning count."""

ROUGH, FINE = 0.5, 0.1
"""Deviation of the ratio before anything is known, and at best: it differs with floor and rate."""

STRETCH = 1.0
"""rad to one side over which is seen how far the ratio is off: a moment's lag is little of it."""

KEPT, PRIOR = 0.9, 0.1
"""What is left of a stretch after the next, and the stretches that what is assumed counts for."""

DELAY_S = 0.2
"""Deviation of the delay before anything is known."""

NO_DELAY = 0.0, 0.0, 1.0 / DELAY_S**2
"""What the sums are when nothing is known of it."""

BLOCK_NOISE, BLOCK_SHARE = 0.01, 0.03
"""Deviation of a block's mean: rad/s, and share of it."""

LAG_S = 0.05
"""s of delay that are no contradiction while the delay is not known."""

CERTAIN_S = 0.004
"""A delay is told when its deviation is below this."""

WINDOW_S = 0.2
"""s over which both must contradict each other."""

LEAST_SLIP = 0.015
"""rad in that time that are never a contradiction: encoder counts, a shake."""

CERTAIN = 3.0
"""Deviations from which on it is one."""


class Match:
    """Takes each line's turn by wheels and by gyro."""

    def __init__(self) -> None:
        self._ww, self._wg = 1.0 / ROUGH**2, 1.0 / ROUGH**2
        """The prior: the ratio is 1, by and large."""
        self._wd, self._dg, self._dd = NO_DELAY
        self._off = self._way = 0.0
        """rad of this stretch that the ratio did not foresee, and that the wheels say,"""
        self._ways = PRIOR * STRETCH**2
        self._offs = ROUGH**2 * self._ways
        """and the squares of both, of the stretches before."""
        self._lag = LAG_S
        self.blocks = 0.0
        """How many blocks of turning are remembered."""
        self._solve()
        self._wheels = self._gyro = self._time = 0.0
        self._rate = self._began = 0.0
        """The wheels' rate now, and when the block began."""
        self._window: deque[tuple[float, float, float]] = deque()
        self._sums = [0.0, 0.0, 0.0]

    @property
    def spread(self) -> float:
        """By how much the ratio is another one from stretch to stretch, as a standard deviation."""
        return math.sqrt(self._offs / self._ways)

    def delay(self) -> float | None:
        """s by which the gyro is later than assumed, once that is certain; then it is assumed."""
        ratio, slope = self.ratio, self._slope
        spread = self._dd - self._wd * self._wd / self._ww
        if ratio < ROUGH / 2 or spread * (CERTAIN_S * ratio) ** 2 < 1.0:
            return None
        self._wd, self._dg, self._dd = NO_DELAY
        self._lag = CERTAIN_S
        self._solve()
        return -slope / ratio

    def add(self, wheels: float, gyro: float, dt: float, slips: bool) -> None:
        """A line: what both say it turned, rad, over its `dt` s; of a slip nothing is learned."""
        self._slide(wheels, gyro, dt)
        rate = wheels / dt
        # The mean of two lines, since a count more or less is a step.
        smooth, self._rate = (rate + self._rate) / 2, rate
        self._wheels += wheels
        self._gyro += gyro
        self._time += dt
        if self._time >= BLOCK_S * 0.95:
            if not slips:
                self._learn(smooth)
            self._wheels = self._gyro = self._time = 0.0
            self._began = smooth

    def contradiction(self, variance: float) -> bool:
        """The gyro, with this variance in rad2 over the window, denies what the wheels say."""
        wheels, gyro, time = self._sums
        if time < WINDOW_S * 0.95:
            return False
        first, last = self._window[0], self._window[-1]
        lag = self._lag * self.ratio * (last[0] / last[2] - first[0] / first[2])
        uncertain = (self.deviation * wheels) ** 2 + lag * lag + variance + LEAST_SLIP**2
        return (gyro - self.ratio * wheels) ** 2 > CERTAIN**2 * uncertain

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

    def _learn(self, ends: float) -> None:
        wheels, gyro = self._wheels / self._time, self._gyro / self._time
        change = (ends - self._began) / self._time
        if abs(wheels) < LEAST_RATE and abs(change) < LEAST_CHANGE:
            return
        weight = 1.0 / (BLOCK_NOISE + BLOCK_SHARE * abs(wheels)) ** 2
        self._way += wheels * self._time
        self._off += (gyro - self.ratio * wheels - self._slope * change) * self._time
        if abs(self._way) >= STRETCH:
            self._offs = KEPT * self._offs + self._off * self._off
            self._ways = KEPT * self._ways + self._way * self._way
            self._off = self._way = 0.0
        self._ww = MEMORY * self._ww + weight * wheels * wheels
        self._wg = MEMORY * self._wg + weight * wheels * gyro
        self._wd = MEMORY * self._wd + weight * wheels * change
        self._dd = MEMORY * self._dd + weight * change * change
        self._dg = MEMORY * self._dg + weight * change * gyro
        if abs(wheels) >= LEAST_RATE:
            self.blocks = MEMORY * self.blocks + 1.0
        self._solve()

    def _solve(self) -> None:
        """The coefficients of w and dw/dt, which stay the same until a block says more."""
        det = self._ww * self._dd - self._wd * self._wd
        self.ratio = (self._wg * self._dd - self._dg * self._wd) / det
        """rad the robot turns per rad its wheels say."""
        self._slope = (self._dg * self._ww - self._wg * self._wd) / det
        self.deviation = max(FINE, ROUGH / math.sqrt(1.0 + self.blocks))
        """How certain the ratio is."""
