"""The upper bound of the pose's covariance: it must not grow more than the motion justifies.

`pose.py` judges a covariance that is too small. With one that is far too large, a filter ignores
the odometry. The error rates in `[odometry]`, with the distance and the turn between two estimates,
limit how much the covariance may grow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from tests.simulate.promises import DIALECTS, BrokenError, Witness
from tests.simulate.roads import NS

Estimate = tuple[int, float, float, float, tuple[float, ...], tuple[float, ...]]

SIZE, RATIO, TRACKS = 0.02, 0.01, {4: 0.3, 2: 0.05}
"""Deviations of a robot that nobody has calibrated, by the number of its wheels."""

ROOM = 10.0
"""Factor allowed beside the bound. It covers terms of second order and the shape of a path."""

COUNTS_M2, COUNTS_RAD2 = 2e-3, 1e-3
"""Allowed beside the bound, for the place of a wheel within an encoder count of 1/96 turn."""

LATE_S = 0.05
"""Time by which a line may be later or earlier than it seems."""

DOUBTS = 2.0
"""Factor of the variance of what the wheels did otherwise than commanded: it may come on top of a
deviation of before the anchor."""

OBEYS = 0.2
"""Share of a speed by which a side certainly obeys: the product allows 30 % in a step."""

ALONE, STEP_S, STEP_COUNTS, LEAST_COUNTS = 2, 0.05, 2.0, 16
"""Steps in which only one of two sides that are equally late is in doubt, the time and the counts
of such a step, and the counts of an encoder that the product assumes."""

REST_NS, RESTS = 3 * NS // 2, 0.05
"""A robot that was slower than this, rad/s, and had no command for this time, has given back what
its motors were late by, so nothing is in doubt any more."""

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
        self._disobeyed = _Disobeyed(witness)
        self._astray = 0.0
        """Way along headings that may be wrong by what the wheels did otherwise, m."""

    def forget(self) -> None:
        """Note that the next estimate's covariance changes for another reason than motion."""
        self._last = None

    def trouble(self) -> None:
        """Note that a line with a wrong speed may have come now."""
        self._calm_ns = CALM_NS

    def roll(self, at_ns: int, angles: Sequence[float]) -> None:
        """Note the true angles of the wheels, rad, in the order of the commands."""
        if self._judged:
            self._disobeyed.roll(at_ns, angles)

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
            self._disobeyed.forget()
            self._astray = 0.0
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
        wheels = self._disobeyed
        self._astray = self._astray + way * wheels.turn if wheels.way else 0.0
        late = COUNTS_M2 + DOUBTS * (wheels.way + self._astray) ** 2
        turned = COUNTS_RAD2 + DOUBTS * (wheels.turn + wheels.alone) ** 2
        wide = self._yaw < UNKNOWN_RAD and xx + yy > ROOM * self._place**2 + late
        if wide or yawyaw > ROOM * self._yaw**2 + turned:
            raise BrokenError(
                "the covariance grows by motion only", now_ns,
                f"variances {xx + yy:.3g} m2 and {yawyaw:.3g} rad2, "
                f"the motion explains {self._place**2:.3g} m2 and {self._yaw**2:.3g} rad2, "
                f"and the wheels {late:.3g} m2 and {turned:.3g} rad2",
            )  # fmt: skip


class _Disobeyed:
    """What the sides did otherwise than commanded, since a rest or an anchor.

    The product doubts steps in which a side differs by 30 %, and may begin and end them anywhere.
    So each sum of a part of the differences is possible: at most those of one sign.
    """

    def __init__(self, witness: Witness) -> None:
        config = witness.config
        self._witness = witness
        self._share: float = witness.radius / (2 * witness.half)
        """The turn of the robot by one of a side."""
        self._lag_s: float = config.get("feedback", {}).get("response_time", 0.2) / 2
        counts = config["mcu"].get("encoder_counts") or LEAST_COUNTS
        self._count = math.tau / counts
        self._step_ns = self._moved_ns = 0
        self._angles = self._due = 0.0, 0.0
        """The angles of the sides, rad, and the speeds due behind the lag, rad/s."""
        self.forget()

    def forget(self) -> None:
        self._way, self._turn = [0.0, 0.0], [0.0, 0.0]
        """Differences of the sum and the difference of both sides, in each direction, rad."""
        self._fastest = 0.0

    def roll(self, at_ns: int, angles: Sequence[float]) -> None:
        witness, seconds = self._witness, (at_ns - self._step_ns) / NS
        if seconds <= 0.0:
            return
        commands = witness.last[1], witness.last[0]
        sides = (angles[1] + angles[2]) / 2, (angles[0] + angles[3]) / 2
        keep, before, due = math.exp(-seconds / self._lag_s), self._angles, self._due
        left, right = [c + (d - c) * keep for c, d in zip(commands, due, strict=True)]
        self._step_ns, self._angles, self._due = at_ns, sides, (left, right)
        rolled = [now - then for now, then in zip(sides, before, strict=True)]
        expected = left * seconds, right * seconds
        off = [one - other for one, other in zip(rolled, expected, strict=True)]
        sizes = [max(abs(one), abs(other)) for one, other in zip(rolled, expected, strict=True)]
        if any(abs(one) > OBEYS * size for one, size in zip(off, sizes, strict=True)):
            self._fastest = max(self._fastest, *(size / seconds for size in sizes))
            for sums, more in ((self._way, off[0] + off[1]), (self._turn, off[1] - off[0])):
                sums[more < 0.0] += abs(more)
        if any(commands) or max(map(abs, rolled)) > RESTS * seconds:
            self._moved_ns = at_ns
        if at_ns - self._moved_ns > REST_NS:
            self.forget()

    @property
    def way(self) -> float:
        """The distance, m, by which they may have done so at most."""
        radius: float = self._witness.radius
        return radius / 2 * (max(self._way) + 2 * LATE_S * self._fastest)

    @property
    def turn(self) -> float:
        """The turn, rad, by which they may have done so at most."""
        return self._share * max(self._turn)

    @property
    def alone(self) -> float:
        """The turn, rad, that a side seems to make which the product doubts alone in a step."""
        step = OBEYS * STEP_S * self._fastest + STEP_COUNTS * self._count if self._fastest else 0.0
        return self._share * ALONE * step
