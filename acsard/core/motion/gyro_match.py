"""Compares a gyro with the wheels: finds the ratio of their turns, and the gyro's delay.

Let w(t) be the turn rate according to the wheels and g(t) that of the gyro, rad/s. Let a be the
ratio of the configured effective track to the true one, and T the delay of the gyro, s. Then

    g(t) = a w(t - T), which is about a w(t) - a T dw/dt for a small T

A least-squares fit finds the coefficients a and -a T from means over blocks of a tenth of a second.
The fit forgets old data only while the robot turns.

Rounding to encoder counts causes an error of w, and the same error appears again in dw/dt. On a
straight drive with coarse counts, this would look like a delay of half a block. Therefore dw/dt
counts as 0 unless the gyro's rate also changes at about the same time (`BLOCKS_BEFORE`,
`BLOCKS_AFTER`).
"""

from __future__ import annotations

import math
from collections import deque

from msgspec import Struct

BLOCK_S = 0.1
"""Duration of a block, over which the turn rates are averaged, s. A single feedback line has too
few encoder counts for a precise rate."""

MIN_TURN_RATE = 0.05
"""Smallest turn rate according to the wheels, rad/s, at which the robot counts as turning."""

MIN_RATE_CHANGE = 0.3
"""Smallest change of the turn rate, rad/s2, from which the delay of the gyro is learned. If the
gyro's rate changes more slowly, the change of the wheels' rate counts as 0."""

FORGETTING_FACTOR = 0.995
"""Factor that reduces the weight of all earlier blocks (`BLOCK_S`) with each block in which the
robot turns. The fit thus remembers 200 blocks (20 s of turning)."""

INITIAL_RATIO_STD, MIN_RATIO_STD = 0.5, 0.1
"""Standard deviations of the ratio of the gyro's turn to the wheels' turn. `INITIAL_RATIO_STD` is
the value that is assumed before any data. `MIN_RATIO_STD` is the smallest value that is assumed,
because floor and turn rate change the ratio."""

STRETCH_ANGLE = 1.0
"""Size of a stretch, which is a turn of the robot to the left or to the right, rad. Each stretch
yields one measurement of the error of the ratio (gyro's turn divided by wheels' turn). The delay of
the gyro hardly matters over such a turn."""

STRETCH_FORGETTING, PRIOR_STRETCHES = 0.9, 0.1
"""`STRETCH_FORGETTING` is the factor by which the weight of the earlier stretches is multiplied in
each new stretch (a turn of `STRETCH_ANGLE`). `PRIOR_STRETCHES` is the initial weight of
`INITIAL_RATIO_STD`, as a number of stretches."""

PRIOR_DELAY_STD_S = 0.2
"""Assumed standard deviation of the gyro's delay before it is measured, s."""

INITIAL_DELAY_SUMS = 0.0, 0.0, 1.0 / PRIOR_DELAY_STD_S**2
"""Initial values of the three least-squares sums from which the delay is computed."""

BLOCKS_BEFORE, BLOCKS_AFTER = 2, 3
"""Numbers of blocks. If the wheels' rate changes in a block, the gyro may show that change up to
`BLOCKS_BEFORE` blocks earlier and up to `BLOCKS_AFTER` blocks later. This covers every delay in
`gyro.DELAY_RANGE_NS`."""

BLOCK_NOISE, BLOCK_SHARE = 0.01, 0.03
"""The mean turn rate over a block (`BLOCK_S`) has a standard deviation of `BLOCK_NOISE` rad/s plus
`BLOCK_SHARE` times the rate."""

ASSUMED_DELAY_STD_S = 0.05
"""Standard deviation of the gyro's delay that `contradiction` assumes before the delay is known,
s."""

MAX_DELAY_STD_S = 0.004
"""Upper limit for the standard deviation of a delay that `Match.delay` returns, s."""

WINDOW_S = 0.2
"""Time over which the turns of gyro and wheels are compared to find a contradiction, s."""

WINDOW_STD = 0.015
"""Standard deviation, rad, of the difference between the turns of gyro and wheels over `WINDOW_S`
without slip. Encoder counts and vibration cause it."""

MAX_DEVIATIONS = 3.0
"""Number of standard deviations by which the turns of gyro and wheels over `WINDOW_S` may differ.
If they differ by more, gyro and wheels contradict each other."""


class Block(Struct, frozen=True, gc=False):
    """Turns of the robot in a block of about `BLOCK_S`, rad: by the wheels, and by the gyro.

    `change` is the change of the turn rate according to the wheels, rad/s2.
    """

    wheels: float
    gyro: float
    change: float
    time: float
    """Duration of the block, s."""
    slips: bool
    """Whether the wheels slip. If they do, nothing is learned from the block."""


class Match:
    """Learns the ratio of the gyro's turns to the wheels' turns, and the delay of the gyro."""

    def __init__(self) -> None:
        self._ww, self._wg = 1.0 / INITIAL_RATIO_STD**2, 1.0 / INITIAL_RATIO_STD**2
        """Sums of the least-squares fit. Their initial values stand for the ratio 1 with the
        standard deviation `INITIAL_RATIO_STD`."""
        self._wd, self._dg, self._dd = INITIAL_DELAY_SUMS
        self._off = self._way = 0.0
        """Sums over the present stretch (a turn of `STRETCH_ANGLE`), rad. `_way` is the turn of the
        wheels. `_off` is the gyro's turn minus the turn that the fit predicts for the gyro."""
        self._ways = PRIOR_STRETCHES * STRETCH_ANGLE**2
        """Weighted sum of the squares of the wheels' turns (`_way`) in the completed stretches,
        rad2."""
        self._offs = INITIAL_RATIO_STD**2 * self._ways
        """Weighted sum of the squares of the fit's errors (`_off`) in the completed stretches,
        rad2."""
        self._lag = ASSUMED_DELAY_STD_S
        self.blocks = 0.0
        """Number of blocks in which the robot turned; old ones count less (`FORGETTING_FACTOR`)."""
        self._solve()
        self._wheels = self._gyro = self._time = 0.0
        self._rate = self._began = 0.0
        """Turn rates according to the wheels, rad/s: now (`_rate`), and at the start of the block
        (`_began`)."""
        self._blocks: deque[Block] = deque(maxlen=BLOCKS_BEFORE + 1 + BLOCKS_AFTER)
        self._window: deque[tuple[float, float, float]] = deque()
        self._sums = [0.0, 0.0, 0.0]

    @property
    def spread(self) -> float:
        """Standard deviation of the ratio of the gyro's turn to the wheels' turn.

        It is measured from the errors of the fit over turns of about `STRETCH_ANGLE` rad each.
        """
        return math.sqrt(self._offs / self._ways)

    def delay(self) -> float | None:
        """Return the correction of the gyro's assumed delay, s, or None if it is uncertain.

        The caller must add the result to the assumed delay, because the measurement then starts
        over.
        """
        ratio, slope = self.ratio, self._slope
        spread = self._dd - self._wd * self._wd / self._ww
        if ratio < INITIAL_RATIO_STD / 2 or spread * (MAX_DELAY_STD_S * ratio) ** 2 < 1.0:
            return None
        self._blocks.clear()
        self._wd, self._dg, self._dd = INITIAL_DELAY_SUMS
        self._lag = MAX_DELAY_STD_S
        self._solve()
        return -slope / ratio

    def add(self, wheels: float, gyro: float, dt: float, slips: bool) -> None:
        """Add a feedback line. When a block is complete, learn from the blocks so far.

        `wheels` and `gyro` are the turns of the robot in the last `dt` s according to wheels and
        gyro, rad. If `slips` is true in the last line of a block, the wheels slip, and nothing is
        learned from this block.
        """
        self._slide(wheels, gyro, dt)
        rate = wheels / dt
        # Use the mean of two lines, because the rate of one line jumps with each encoder count.
        smooth, self._rate = (rate + self._rate) / 2, rate
        self._wheels += wheels
        self._gyro += gyro
        self._time += dt
        if self._time >= BLOCK_S * 0.95:
            change = (smooth - self._began) / self._time
            self._blocks.append(Block(self._wheels, self._gyro, change, self._time, slips))
            if len(self._blocks) == self._blocks.maxlen:
                self._learn()
            self._wheels = self._gyro = self._time = 0.0
            self._began = smooth

    def contradiction(self, variance: float) -> bool:
        """Return whether the turns of gyro and wheels in the last `WINDOW_S` s are contradictory.

        `variance` is the variance of the gyro's turn over this time, rad2.
        """
        wheels, gyro, time = self._sums
        if time < WINDOW_S * 0.95:
            return False
        first, last = self._window[0], self._window[-1]
        lag = self._lag * self.ratio * (last[0] / last[2] - first[0] / first[2])
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

    def _learn(self) -> None:
        block = self._blocks[BLOCKS_BEFORE]
        wheels, gyro, change = block.wheels / block.time, block.gyro / block.time, block.change
        # The blocks before and after this block show whether the gyro's rate changes, too.
        rates = [neighbor.gyro / neighbor.time for neighbor in self._blocks]
        if max(rates) - min(rates) < MIN_RATE_CHANGE * BLOCK_S:
            change = 0.0
        if block.slips or (abs(wheels) < MIN_TURN_RATE and abs(change) < MIN_RATE_CHANGE):
            return
        weight = 1.0 / (BLOCK_NOISE + BLOCK_SHARE * abs(wheels)) ** 2
        self._way += block.wheels
        self._off += (gyro - self.ratio * wheels - self._slope * change) * block.time
        if abs(self._way) >= STRETCH_ANGLE:
            self._offs = STRETCH_FORGETTING * self._offs + self._off * self._off
            self._ways = STRETCH_FORGETTING * self._ways + self._way * self._way
            self._off = self._way = 0.0
        self._ww = FORGETTING_FACTOR * self._ww + weight * wheels * wheels
        self._wg = FORGETTING_FACTOR * self._wg + weight * wheels * gyro
        self._wd = FORGETTING_FACTOR * self._wd + weight * wheels * change
        self._dd = FORGETTING_FACTOR * self._dd + weight * change * change
        self._dg = FORGETTING_FACTOR * self._dg + weight * change * gyro
        if abs(wheels) >= MIN_TURN_RATE:
            self.blocks = FORGETTING_FACTOR * self.blocks + 1.0
        self._solve()

    def _solve(self) -> None:
        det = self._ww * self._dd - self._wd * self._wd
        self.ratio = (self._wg * self._dd - self._dg * self._wd) / det
        """The turn of the gyro divided by the turn of the wheels; a in the module's docstring."""
        self._slope = (self._dg * self._ww - self._wg * self._wd) / det
        self.deviation = max(MIN_RATIO_STD, INITIAL_RATIO_STD / math.sqrt(1.0 + self.blocks))
        """Assumed standard deviation of `ratio`. It falls from `INITIAL_RATIO_STD` to
        `MIN_RATIO_STD`."""
