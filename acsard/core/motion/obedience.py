"""Finds the motion of a wheel that no delay of its motor explains.

A motor follows its command behind a lag and a dead time, and neither is known exactly. So each of
`DELAYS` + 1 delays, from 0 to `DEAD_TIME_S` or the response time, is a hypothesis. It allows the
speeds between the command, and the command behind half and behind all of the response time, each of
that time ago, and `AGREEMENT` more or less. For each hypothesis a sum takes what the wheel rolls
beyond these speeds or against them, less what the wheel changed toward them (a wheel that reacts
may only be slow). The least sum is motion that nothing explains. Commands that move to and fro take
nothing from it, and neither does a lost link: only the wheel itself does.
"""

from __future__ import annotations

from msgspec import Struct, field

from acsard.core.values import Rad, RadPerS, Seconds

DELAYS = 12
DEAD_TIME_S = 0.6

AGREEMENT = 0.3  # fraction of a speed by which a sound wheel may differ
# Noise of a smoothed speed, in counts in the time in which it is smoothed, and at most this many
# times the speed that is due: a wheel that ought to stand shows none.
NOISE_COUNTS, MAX_NOISE_RATIO = 0.7, 10.0
REACTION = 2.0  # weight of the change of a wheel in one time of `DELAYS` delays
LEAK_S = 10.0  # while a hypothesis explains the motion
# Largest fraction of the evidence for a fault that is kept: a wheel that obeys again is sound soon.
MAX_EVIDENCE = 1.5


def _zeros() -> list[float]:
    return [0.0] * (DELAYS + 1)


# The least and the largest speed, and the least and largest magnitude that is not slow or fast.
Bounds = tuple[RadPerS, RadPerS, RadPerS, RadPerS]


class Expected(Struct):
    """The speeds that a side may have by each hypothesis, the least delay first."""

    low: list[RadPerS] = field(default_factory=_zeros)
    high: list[RadPerS] = field(default_factory=_zeros)

    @property
    def most(self) -> RadPerS:
        """The largest speed that was due in the time of all delays."""
        return max(max(self.high), -min(self.low))

    def in_direction_of(self, speed: RadPerS) -> RadPerS:
        """Return the largest speed due in this direction; below 0 if only the opposite was."""
        return max(self.high) if speed > 0.0 else -min(self.low)

    def add(self, *speeds: RadPerS) -> None:
        """Add the newest speeds; the due ones lie between them."""
        self.low.insert(0, min(speeds))
        self.high.insert(0, max(speeds))
        self.low.pop()
        self.high.pop()

    def bounds(self, noise: RadPerS) -> list[Bounds]:
        """Return what a sound wheel may do. `noise` is that of a smoothed speed."""
        bounds = []
        for low, high in zip(self.low, self.high, strict=True):
            slow = low if low > 0.0 else -high if high < 0.0 else 0.0
            fast = low + high if low + high > 0.0 else -low - high
            unsure = MAX_NOISE_RATIO * (high if high > -low else -low)
            if noise < unsure:
                unsure = noise
            low -= AGREEMENT * (low if low > 0.0 else -low) + unsure
            high += AGREEMENT * (high if high > 0.0 else -high) + unsure
            bounds.append((low, high, (1.0 - AGREEMENT) * slow, (1.0 + AGREEMENT) / 2 * fast))
        return bounds


class Obedience(Struct):
    """The sums of a wheel, in rad, one for each hypothesis."""

    speeds: list[RadPerS] = field(default_factory=_zeros)  # smoothed, the newest first
    astray: list[Rad] = field(default_factory=_zeros)  # beyond what is due, or against it
    fast: list[Rad] = field(default_factory=_zeros)  # faster by more than `AGREEMENT`
    slow: list[Rad] = field(default_factory=_zeros)
    limit: Rad = 0.0  # the last evidence for a fault

    @property
    def unexplained(self) -> Rad:
        """How far the wheel rolled on, too far or the wrong way, whatever its delay is."""
        return min(self.astray)

    def add(
        self, speed: RadPerS, shown: RadPerS, bounds: list[Bounds], s: Seconds, limit: Rad
    ) -> None:
        """Add smoothed speeds of `s` seconds, and `limit`, the evidence for a fault.

        `shown` is the magnitude with the counts that a wheel shows to and fro at their edge.
        """
        speeds, most = self.speeds, MAX_EVIDENCE * limit
        # Evidence is a share of its bound: that of a fast wheel is not beyond that of a slow one.
        share = limit / self.limit if self.limit else 1.0
        keep, self.limit = share * (1.0 - s / LEAK_S), limit
        speeds.insert(0, speed)
        change = REACTION * (speed - speeds.pop())
        turns = speed
        if speed < 0.0:
            turns, change = -speed, -change
        astray, fast, slow = [], [], []
        for was, was_fast, was_slow, (low, high, least, largest) in zip(
            self.astray, self.fast, self.slow, bounds, strict=True
        ):
            beyond = speed - high if speed > 0.0 else low - speed
            if beyond > 0.0:
                # A wheel that turns too little has rolled nothing too far.
                beyond = beyond if beyond < turns else turns
                # Away from what is due, a change counts as much as what is beyond it.
                was = was * share + (beyond + (change if change < beyond else beyond)) * s
            else:
                was *= keep
            astray.append(0.0 if was < 0.0 else most if was > most else was)
            was_fast = was_fast * share + (turns - largest) * s
            fast.append(0.0 if was_fast < 0.0 else most if was_fast > most else was_fast)
            was_slow = was_slow * share + (least - shown) * s
            slow.append(0.0 if was_slow < 0.0 else most if was_slow > most else was_slow)
        self.astray, self.fast, self.slow = astray, fast, slow

    def forget(self) -> None:
        self.astray, self.fast, self.slow = _zeros(), _zeros(), _zeros()
