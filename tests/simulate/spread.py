"""The upper bound of the pose's covariance: it must not grow more than the motion justifies.

`pose.py` judges a covariance that is too small. With one that is far too large, a filter ignores
the odometry. The error rates in `[odometry]`, with the distance and the turn between two estimates,
limit how much the covariance may grow.
"""

from __future__ import annotations

import math

from tests.simulate.promises import DIALECTS, BrokenError, Witness
from tests.simulate.roads import NS

Estimate = tuple[int, float, float, float, tuple[float, ...], tuple[float, ...]]

SIZE, RATIO, TRACKS = 0.02, 0.01, {4: 0.3, 2: 0.05}
"""Deviations of a robot that nobody has calibrated, by the number of its wheels."""

ROOM = 10.0
"""Factor allowed beside the bound. It covers terms of second order and the shape of a path."""

DOUBT_M2, DOUBT_RAD2 = 0.09, 0.09
"""Allowed beside the bound, 0.3 m and 0.3 rad: wheels that do not obey at once leave what was
commanded in doubt. It also covers lines that come late, and the place of a wheel within a count."""

DELAY_S = 2.0
"""What a motor may seem to be late by is in doubt: at most about the motion of this time."""

UNKNOWN_RAD = 1.0
"""Deviation of the heading from which on the position is not judged: terms of second order, which
are larger than those of first order then, make it far too uncertain rather than too certain."""

CALM_NS = 8 * NS // 5
"""Time of motion after trouble in which the wheels of a side may still seem to slip. One wrong
speed affects the comparison of the wheels for 0.7 s at 100 Hz, and for 1.05 s at 20 Hz. A slip ends
when the wheels have agreed for 0.5 s, which wheels at rest do not show."""

SHORTEST_NS = 10_000_000
"""Shortest period in which the counts of an encoder do not look like slip."""

LONGEST_NS = NS // 10
"""From this period on, a line that a command has caused shortly before the next one looks like slip
too: the board computes its speeds from few counts, and the daemon takes them for a whole period."""

LEAST_NS = 12_000_000
"""The lines of a board that answers each line come in at least this period."""


class Spread:
    """The largest standard deviations that the motion since an anchor justifies."""

    def __init__(self, witness: Witness) -> None:
        config = witness.config
        self._by_metre, self._yaw_by_metre, self._yaw_by_radian = 1e-4, 1e-4, 1e-2
        """The rates of `[odometry]` that a configuration without this table has."""
        # Slow motors, odd radii, and few counts or short periods look like slip, which widens it.
        usual = SHORTEST_NS <= witness.period_ns < LONGEST_NS
        counts = config.get("sim", {}).get("encoder_counts")
        mcu_counts = config["mcu"].get("encoder_counts")
        coarse = counts == 96 and not mcu_counts
        self._rough = counts == 400 and not mcu_counts
        """Whether lines that follow each other sooner than `SHORTEST_NS` look like slip."""
        # A wrong number of counts, once it is known, makes the pose doubtful.
        miscounts = mcu_counts and mcu_counts != (counts or 3200)
        self._judged = not (config.get("odometry") or coarse or miscounts) and usual
        self._track, self._track_std = 2 * witness.half, TRACKS[len(set(witness.names))]
        every_s = max(witness.period_ns / NS, config["mcu"].get("reply_period", 0.0))
        self._longest_ns = 2 * max(int(every_s * NS), LEAST_NS)
        """A longer time between two estimates is a gap, in which the covariance grows faster."""
        self._calm_ns = 0
        """Time of motion until the wheels are certainly calm."""
        self._last: Estimate | None = None
        self._place = self._yaw = 0.0
        """Standard deviation of the position, m, and of the heading, rad: the bounds."""
        self._late = self._turned = 0.0
        """The motion in about the last `DELAY_S`, m and rad."""

    def forget(self) -> None:
        """Note that the next estimate's covariance changes for another reason than motion."""
        self._last = None

    def trouble(self) -> None:
        """Note that a line with a wrong speed may have come now."""
        self._calm_ns = CALM_NS

    def see(self, now_ns: int, estimate: Estimate, faults: set[str]) -> None:
        """Judge an estimate while the board has these faults."""
        if not self._judged:
            return
        if not faults <= DIALECTS:
            self.trouble()
        last, self._last = self._last, estimate
        if self._rough and last is not None and estimate[0] - last[0] < SHORTEST_NS:
            self.trouble()
        _, x, y, yaw, (xx, _, _, yy, _, yawyaw), _ = estimate
        if last is not None and (x, y, yaw) != last[1:4]:
            self._calm_ns -= estimate[0] - last[0]
        if last is None or self._calm_ns > 0 or estimate[0] - last[0] > self._longest_ns:
            self._place, self._yaw = math.sqrt(xx + yy), math.sqrt(yawyaw)
            return
        way = math.hypot(x - last[1], y - last[2])
        turn = abs(math.remainder(yaw - last[3], math.tau))
        # The rates are of a robot as a whole. Those of its two sides have twice the sum at most.
        rolled = 2 * way + self._track * turn / 2
        # Errors of the size, of the ratio and of the track add up along the whole way.
        place = self._place + way * (self._yaw + SIZE)
        self._place = math.sqrt(place**2 + self._by_metre * rolled)
        yaw = self._yaw + RATIO * way / self._track + self._track_std * turn
        self._yaw = math.sqrt(yaw**2 + self._yaw_by_metre * rolled + self._yaw_by_radian * turn)
        keep = math.exp((last[0] - estimate[0]) / (DELAY_S * NS))
        self._late, self._turned = keep * self._late + way, keep * self._turned + turn
        late, turned = self._late**2 + DOUBT_M2, self._turned**2 + DOUBT_RAD2
        wide = self._yaw < UNKNOWN_RAD and xx + yy > ROOM * self._place**2 + late
        if wide or yawyaw > ROOM * self._yaw**2 + turned:
            raise BrokenError(
                "the covariance grows by motion only", now_ns,
                f"variances {xx + yy:.3g} m2 and {yawyaw:.3g} rad2, "
                f"the motion explains {self._place**2:.3g} m2 and {self._yaw**2:.3g} rad2",
            )  # fmt: skip
