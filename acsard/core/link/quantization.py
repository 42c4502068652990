"""Detects the quantization of the reported speeds and recovers whole encoder counts from them.

If the counts per turn are configured, `whole_counts.py` recovers them. Otherwise they are searched:
if a wheel's speeds are multiples of a quantization step (`quantization_step.py`), each speed is a
whole number of counts. With the firmware's period it is then an exact angle, so a line tells
exactly how far the wheel turned. The period by which a firmware divides is a round number near the
mean period of its lines. It is proven if it makes the counts per turn whole. Each wheel has an
encoder of its own.

The counts are trusted while they agree with the times of the lines. If the firmware starts to
report in another way, or the port is reopened, learning starts over.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.quantization_step import FINEST, ROUNDING, Quantization, Search, on
from acsard.core.link.whole_counts import WholeCounts

FLICKER = 0.0105
"""rad/s. A smaller step is only rounding."""

BLOCK = 64
"""Steps that are examined together: enough for three counts even if a filter smooths few counts."""

FIRST = 24
"""Steps of the first block after which `size` has a first value, which may still grow."""

RECUR = 3
"""Number of steps of a block that must reach a size. One damaged line makes two."""

LEARNED_FROM = 100
"""Changes of a wheel's speed before a quantization step is searched."""

MOST_SEEN = 256
"""Different speeds remembered, which bounds a search."""

MOST_TOLD = 512
"""Different speeds whose rounding is corrected later: as many as 10 000 counts a turn make."""

OWED_FOR = 3000
"""Lines after which the owed correction is dropped, because it belongs to another place."""

LONGEST_WAIT = 128 * LEARNED_FROM
"""Largest number of changes between two searches of speeds without a step: minutes of
driving."""

LOOK = 50
"""Lines from one check of the findings to the next."""

LONG = 100
"""Checks over which the mean period is taken."""

STRAYS = 4
"""Speeds off the step that refute it. Each check forgives one, because 2 % may be damaged."""

ROUND_PERIOD = 0.006
"""Relative error of a period against its round number. A ceramic resonator has 0.5 %."""

APART_S, MOST_APART = 0.1, 5.0
"""Largest difference between the counts and the times of the lines: in s, or in periods if that is
more."""

KEPT = 0.98
"""Share of that difference that is kept with each line, because two clocks drift apart for ever."""

GLANCE, MISSING = 10, 0.6
"""Lines, and periods by which all of them were late. Then a line is missing that gap filling has
not counted."""

ALIKE = 3.0
"""Bound on a wheel's reported step, as a multiple of the second largest of the four. Random jumps
look like steps too, and only proven counts may be coarser than this."""

COARSE, JUMP_GAIN = 0.015, 0.06
"""Mean jump of a wheel, rad per line, from which on its encoder counts as coarse, and the gain of
its filter. About 200 counts a turn reach it."""

LONGEST_LINE = 0.03
"""Time of a line, s, above which the motors' own accelerations look like jumps."""

NOTHING = (0.0, 0.0, 0.0, 0.0)


class Steps:
    """The step of one wheel's reported speed from line to line that its encoder causes.

    One count more or less in a period is a step of 2 pi / (counts T): 31 rad/s at 20 counts a turn
    and 100 Hz. It is not an acceleration. The size is learned from the reports, so it holds for any
    firmware, whether it divides counts by its nominal period or by the measured time, or filters
    them. Steps that come from counts recur. A damaged line makes only two, one there and one back.

    `size` is in rad/s, `math.inf` until enough steps were seen.
    """

    def __init__(self) -> None:
        self.size = math.inf
        self._before = math.inf
        self._last = 0.0
        self._largest = [0.0] * RECUR
        self._count = 0

    def add(self, speed: float) -> None:
        """Take the next reported speed, rad/s."""
        step = abs(speed - self._last)
        if step < FLICKER:
            return
        self._last = speed
        largest = self._largest
        if step > largest[0]:
            largest[0] = step
            largest.sort()
            if largest[0] > self.size:
                self.size = largest[0]
        self._count += 1
        if self._count == FIRST and self.size == math.inf:
            self.size = largest[0]
        if self._count == BLOCK:
            # At its start a block has seen too little, so the size of the block before still
            # counts.
            self._before, self._count = largest[0], 0
            self.size, self._largest = self._before, [0.0] * RECUR


class Coarseness:
    """Detects wheel speeds that jump to and fro from line to line, as those of coarse encoders do.

    A change of the acceleration is a jump as well, but lasts for one line.
    """

    def __init__(self) -> None:
        self._rows = NOTHING, NOTHING
        """The speeds of the last two lines, rad/s."""
        self._jumps, self._wheel = [0.0] * 4, 0
        """Filtered jump of each wheel, rad per line, and the wheel of the last line."""

    def add(self, speeds: Motors, own: float) -> bool:
        """Take the speeds of a line over `own` s; return whether the encoders look coarse."""
        (older, before), self._rows = self._rows, (self._rows[1], speeds)
        if speeds == NOTHING == before or own > LONGEST_LINE:
            return False
        # One wheel per line keeps every step short.
        wheel = self._wheel = (self._wheel + 1) % 4
        mean, jump = self._jumps[wheel], abs(older[wheel] - 2 * before[wheel] + speeds[wheel])
        self._jumps[wheel] = mean = mean + JUMP_GAIN * (own / 2 * jump - mean)
        return mean > COARSE


class WheelCounter:
    """The encoder of one wheel; `counts` per turn, 0 until they are known.

    It learns from changes of the speed, because a steady speed repeats one value. When the counts
    are known, each speed is an angle of whole counts, without a rounding error. The error until
    then is corrected afterwards, from the number of times that each speed was reported.
    """

    def __init__(self) -> None:
        self.counts = self.off = 0
        self.quantum = self.angle = 0.0
        """One count in a period, as a speed in rad/s and as an angle in rad."""
        self.steps = Steps()
        self.lattice: Quantization | None = None
        self._search: Search | None = None
        self._told: dict[float, int] | None = {}
        """How often each speed was reported before the counts were known, forward minus backward.
        None if there were too many different speeds."""
        self._owing = 0
        """Number of lines in `_told`."""
        self._last = 0.0
        self._seen: dict[float, int] = {}
        self._missing = self._patience = LEARNED_FROM
        """Changes until the next search, and changes to the one after it."""

    def learn(self, speed: float) -> None:
        """Take the next report of a wheel whose counts are unknown."""
        self._owing += 1
        if self._owing > OWED_FOR:
            self.forgive()
        if speed and self._told is not None:
            size, way = abs(speed), 1 if speed > 0 else -1
            self._told[size] = self._told.get(size, 0) + way
            if len(self._told) > MOST_TOLD:
                self._told = None
        if self._search is None and abs(speed - self._last) >= FLICKER:
            self._last, size = speed, abs(speed)
            self._missing -= 1
            fresh = self._missing < LEARNED_FROM or self.lattice is not None
            room = size in self._seen or len(self._seen) < MOST_SEEN
            if fresh and room and size >= FINEST:
                self._seen[size] = self._seen.get(size, 0) + 1
            if self._missing <= 0 and self._seen:
                self._search = Search(self._seen)

    def go_on(self) -> bool:
        """Continue the search, if one runs; return whether it has just found a step."""
        if self._search is None:
            return False
        if not self._search.go_on():
            return False
        self.lattice, self._search = self._search.found, None
        if self.lattice is None:
            self._seen = {}
        self._missing = self._patience
        self._patience = min(2 * self._patience, LONGEST_WAIT)
        return self.lattice is not None

    def turned(self, speed: float, own: float, missing: float) -> float:
        """Return the angle that the wheel turned in the `own` s of this line, rad.

        The result includes `missing` s of lines that were lost before it.
        """
        if not self.counts:
            self.steps.add(speed)
            self.learn(speed)
            return speed * own
        whole = round(speed / self.quantum)
        if abs(speed - whole * self.quantum) > ROUNDING:
            self.off += 1
            return speed * own
        return whole * self.angle + speed * missing

    def owed(self, period: float) -> float:
        """Return and reset the rounding errors of the lines before the counts were known, rad."""
        told, self._told = self._told or {}, None
        return math.fsum(
            times * (round(speed / self.quantum) * self.angle - speed * period)
            for speed, times in told.items()
            if on(speed, self.quantum)
        )

    def forgive(self) -> None:
        """Drop the correction for everything until now."""
        self._owing = 0
        if self._told is not None:
            self._told = None if self.counts else {}

    def show(self, period: float) -> bool:
        """Return whether `period` s, as the firmware's divisor, makes the counts per turn whole.

        If it does, adopt these counts.
        """
        counts = self.lattice.counts(period) if self.lattice and not self.counts else 0
        if counts:
            self.counts, self.angle = counts, math.tau / counts
            self.quantum = self.angle / period
            self.lattice = Quantization(self.quantum, 0.0)
            self._search, self.off = None, 0
        return self.counts > 0


class CountRecovery:
    """The quantization of all wheels, learned from every good line of one port."""

    def __init__(self, counts: int = 0) -> None:
        """Start. `counts` are the configured counts per turn; 0 means that the speeds show them."""
        self._configured, self._whole = counts, WholeCounts(counts)
        self.coarse_lines = 0
        """Number of lines with the jumps of coarse encoders of which nobody knows the counts."""
        self.forget()

    def forget(self) -> None:
        """Start over: the board may be another one, or it reports in another way."""
        self._whole.forget()
        self._coarseness = Coarseness()
        self._wheels = [WheelCounter() for _ in NOTHING]
        self._owing: list[int] = []
        self._reported, self._steps = NOTHING, NOTHING
        """rad/s. The step that each wheel reports, and the bounded step that is passed on."""
        self._time, self._lines = 0.0, 0
        self._period = self._apart = self._least = 0.0
        """Seconds. The period by which the firmware divides, 0 while unknown; the excess of the
        lines' times over the counts; the least excess in the present group of `GLANCE` lines."""

    def forgive(self) -> None:
        """Drop the corrections for past rounding, because the pose was reset."""
        for wheel in self._wheels:
            wheel.forgive()

    @property
    def counts(self) -> tuple[int, ...]:
        """Counts per turn of each wheel's encoder, in `WHEELS` order; 0 if unknown.

        They are the configured ones unless the speeds are not whole counts of these.
        """
        if self._configured:
            return (self._configured if self._whole.believed else 0,) * 4
        return tuple([wheel.counts for wheel in self._wheels])

    def look(self, line: Feedback) -> Feedback:
        """Return the line with each wheel's counted angle and quantization step, where known."""
        own, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if self._whole.angle:
            if line.turned is None and own > 0.0:
                counted = self._whole.turned(speeds, own)
            else:
                self._whole.pause()
        elif line.turned is None and own > 0.0:
            counted = self._counted(speeds, own)
            if counted is None and self._coarseness.add(speeds, own):
                self.coarse_lines += 1
        a, b, c, d = self._wheels
        if counted is None or self._configured:
            a.steps.add(speeds[0])
            b.steps.add(speeds[1])
            c.steps.add(speeds[2])
            d.steps.add(speeds[3])
        reported = a.steps.size, b.steps.size, c.steps.size, d.steps.size
        if reported != self._reported:
            self._reported, self._steps = reported, self._bounded(reported)
        return replace(line, counted=counted, steps=self._steps, count=self._whole.angle)

    def _bounded(self, reported: Motors) -> Motors:
        """Return the step of each wheel's speed, from its reports or its proven counts, rad/s."""
        most = ALIKE * sorted(reported)[2]
        a, b, c, d = (
            wheel.quantum or min(step, most)
            for wheel, step in zip(self._wheels, reported, strict=True)
        )
        return a, b, c, d

    def _counted(self, speeds: Motors, own: float) -> Motors | None:
        """Return how far each wheel turned in the `own` s of this line, rad, or None if unknown."""
        self._lines, self._time = self._lines + 1, self._time + own
        if not self._lines % LOOK and not self._take_a_look():
            return None
        if self._wheels[self._lines % len(self._wheels)].go_on():
            self._settle()
        wheels, period = self._wheels, self._period
        if not period:
            for wheel, speed in zip(wheels, speeds, strict=True):
                wheel.learn(speed)
            return None
        missing = self._missing(own)
        if missing is None:
            # The times of the lines correct the excess or shortfall of the counts.
            settled = self._apart + period
            self.forget()
            front_right, front_left, rear_left, rear_right = (s * settled for s in speeds)
            return front_right, front_left, rear_left, rear_right
        a, b, c, d = wheels
        counted = (
            a.turned(speeds[0], own, missing),
            b.turned(speeds[1], own, missing),
            c.turned(speeds[2], own, missing),
            d.turned(speeds[3], own, missing),
        )
        return self._made_good(counted) if self._owing else counted

    def _missing(self, own: float) -> float | None:
        """Return the duration of missing lines before this one that no gap filling has counted, s.

        Return None if the times of the lines contradict the counts.
        """
        period = self._period
        apart = self._apart = self._apart * KEPT + own - period
        if abs(apart) > max(APART_S, MOST_APART * period):
            return None
        if apart < self._least:
            self._least = apart
        if self._lines % GLANCE:
            return 0.0
        least, self._least = self._least, apart
        missing = round(least / period) * period if least > MISSING * period else 0.0
        self._apart -= missing
        return missing

    def _made_good(self, counted: Motors) -> Motors:
        """Add the correction owed to one wheel. One wheel per line keeps every step short."""
        wheel, angles = self._owing.pop(), list(counted)
        angles[wheel] += self._wheels[wheel].owed(self._period)
        a, b, c, d = angles
        return a, b, c, d

    def _take_a_look(self) -> bool:
        """Return whether the wheels still report as before. If not, start over."""
        wheels = self._wheels
        if any(wheel.off > STRAYS for wheel in wheels):
            self.forget()
            return False
        for wheel in wheels:
            wheel.off = max(0, wheel.off - 1)
        self._settle()
        if self._lines >= LONG * LOOK:
            self._time, self._lines = 0.0, 0
        return True

    def _settle(self) -> None:
        """Find the counts per turn and the period that explain the quantization steps."""
        found = [i for i, w in enumerate(self._wheels) if w.lattice and not w.counts]
        if not found or self._lines < LOOK:
            return
        for period in [self._period] if self._period else _round(self._time / self._lines):
            shown = [i for i in found if self._wheels[i].show(period)]
            self._owing += shown
            if shown:
                self._period, self._reported = period, NOTHING
                return


def _round(mean: float) -> list[float]:
    """Return the periods, s, by which a firmware may divide if its lines are `mean` s apart."""
    near = (round(mean * 1000) / 1000, 1 / max(1, round(1 / mean)))
    return [period for period in near if abs(mean - period) <= ROUND_PERIOD * mean]
