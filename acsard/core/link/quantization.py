"""Measures how coarsely encoders show in the reported speeds, and adds whole counts to each line.

If the counts per turn are configured, `whole_counts.py` recovers the counts from the speeds. If
they are not, the pose uses speed times time: nobody can tell from the speeds alone how many counts
a turn has, unless the firmware divides by a fixed period. Then the time of a line is known as well,
and only the rounding to two decimals is left.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.whole_counts import WholeCounts

FLICKER = 0.0105
"""rad/s. A smaller step is only rounding."""

BLOCK = 64
"""Steps that are examined together: enough for three counts even if a filter smooths few counts."""

FIRST = 24
"""Steps of the first block after which `size` has a first value, which may still grow."""

RECUR = 3
"""Number of steps of a block that must reach a size. One damaged line makes two."""

ALIKE = 3.0
"""Bound on a wheel's reported step, as a multiple of the second largest of the four. Random jumps
look like steps too."""

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


class CountRecovery:
    """The quantization of all wheels, learned from every good line of one port."""

    def __init__(self, counts: int = 0) -> None:
        """Start; `counts` are the configured counts per turn, 0 if nobody knows them."""
        self._configured, self._whole = counts, WholeCounts(counts)
        self.coarse_lines = 0
        """Number of lines with the jumps of coarse encoders of which nobody knows the counts."""
        self.forget()

    def forget(self) -> None:
        """Start over: the board may be another one, or it reports in another way."""
        self._whole.forget()
        self._coarseness = Coarseness()
        self._wheels = tuple(Steps() for _ in NOTHING)
        self._reported, self._steps = NOTHING, NOTHING
        """rad/s. The step that each wheel reports, and the bounded step that is passed on."""

    @property
    def counts(self) -> tuple[int, ...]:
        """Configured counts per turn of each wheel, 0 if the speeds are not whole counts."""
        return (self._configured if self._whole.believed else 0,) * 4

    def look(self, line: Feedback) -> Feedback:
        """Return the line with each wheel's counted angle and quantization step, where known."""
        own, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if self._whole.angle:
            if line.turned is None and own > 0.0:
                counted = self._whole.turned(speeds, own)
            else:
                self._whole.pause()
        elif own > 0.0 and self._coarseness.add(speeds, own):
            self.coarse_lines += 1
        a, b, c, d = self._wheels
        a.add(speeds[0])
        b.add(speeds[1])
        c.add(speeds[2])
        d.add(speeds[3])
        reported = a.size, b.size, c.size, d.size
        if reported != self._reported:
            most = ALIKE * sorted(reported)[2]
            self._reported = reported
            self._steps = min(a.size, most), min(b.size, most), min(c.size, most), min(d.size, most)
        return replace(line, counted=counted, steps=self._steps, count=self._whole.angle)
