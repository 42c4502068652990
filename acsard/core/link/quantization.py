"""Adds to each good line the angles in whole encoder counts, and the quantization of its speeds.

A coarse encoder quantizes the reported speed of its wheel. If the counts per turn are configured,
`whole_counts.py` recovers the counts from the speeds. Otherwise the pose uses speed times time.

If the counts per turn are not configured, the module does not try to find them from the speeds.
They can be found only if the firmware divides its counts by a fixed period. In this case they would
not help: the time between the lines is known, so speed times time is wrong only by the rounding of
the speeds.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.whole_counts import WholeCounts

MIN_CHANGE = 0.0105
"""Smallest change of a wheel's reported speed that is more than rounding, rad/s."""

BLOCK_STEPS = 64
"""Number of steps (changes of a reported speed) in a block. At the end of each block, `Steps.size`
is computed again from the steps of the block. Even if counts are rare and the firmware filters the
speeds, at least three counts fall into a block."""

FIRST_STEPS = 24
"""Number of steps (changes of a reported speed) after which `Steps.size` gets its first value.
Until the end of the block, this value may still grow."""

STEP_RANK = 3
"""Rank of the change of a reported speed that becomes `Steps.size`: the third largest change of a
block. The largest change would be wrong, because a single damaged line causes two large changes."""

MAX_STEP_RATIO = 3.0
"""Upper bound on the quantization step of a wheel, as a multiple of the second largest step among
the four wheels. The bound is needed because random jumps of a speed look like quantization too."""

COARSE, JUMP_GAIN = 0.015, 0.06
"""`COARSE` is the mean jump of a wheel's speed above which its encoder is treated as coarse, rad
per line. A jump is half of the difference between two successive speed changes, times the time
between the lines. An encoder with about 200 counts a turn reaches this value. `JUMP_GAIN` is the
gain of the filter for the mean jump."""

MAX_INTERVAL_S = 0.03
"""Longest time between two lines whose speeds `Coarseness` compares, s. Over a longer time, the
accelerations of the motors look like jumps."""

NO_STEPS = (0.0, 0.0, 0.0, 0.0)


class Steps:
    """The size of the steps that an encoder causes in the reported speed of its wheel.

    One count more or less in a period T changes the reported speed by 2 pi / (counts per turn x T).
    This is 31 rad/s at 20 counts per turn and 100 Hz. Such a step does not show an acceleration of
    the wheel. The class learns the size from the reported speeds. Therefore the size is correct for
    any firmware, even if the firmware filters the speeds or divides the counts by its nominal
    period instead of the measured time.

    `size` is in rad/s. It is `math.inf` until `FIRST_STEPS` steps have occurred.
    """

    def __init__(self) -> None:
        self.size = math.inf
        self._before = math.inf
        self._last = 0.0
        self._largest = [0.0] * STEP_RANK
        self._count = 0

    def add(self, speed: float) -> None:
        """Process the next reported speed, rad/s."""
        step = abs(speed - self._last)
        if step < MIN_CHANGE:
            return
        self._last = speed
        largest = self._largest
        if step > largest[0]:
            largest[0] = step
            largest.sort()
            if largest[0] > self.size:
                self.size = largest[0]
        self._count += 1
        if self._count == FIRST_STEPS and self.size == math.inf:
            self.size = largest[0]
        if self._count == BLOCK_STEPS:
            # A new block has too few steps at first, so it starts with the size of this block.
            self._before, self._count = largest[0], 0
            self.size, self._largest = self._before, [0.0] * STEP_RANK


class Coarseness:
    """Detector of wheel speeds that jump back and forth from line to line, as with coarse encoders.

    Let v0, v1 and v2 be the speeds of a wheel in the last three lines, and dt the time since the
    previous line. Then the jump of the wheel is |v0 - 2 v1 + v2| dt / 2. A change of the
    acceleration causes a jump too, but only in one line.
    """

    def __init__(self) -> None:
        self._rows = NO_STEPS, NO_STEPS
        self._jumps, self._wheel = [0.0] * 4, 0
        """`_jumps` is the mean jump of each wheel, rad per line. `_wheel` is the index of the wheel
        that was examined in the last line."""

    def add(self, speeds: Motors, elapsed_s: float) -> bool:
        """Process the speeds of a line, and return whether the examined encoder is coarse.

        Each call examines the encoder of one wheel, and the wheels take turns. `speeds` are the
        speeds of the four wheels, rad/s. `elapsed_s` is the time since the previous line. Return
        False without an examination if `elapsed_s` exceeds `MAX_INTERVAL_S`, or if all speeds of
        this line and of the previous line are 0.
        """
        (older, before), self._rows = self._rows, (self._rows[1], speeds)
        if speeds == NO_STEPS == before or elapsed_s > MAX_INTERVAL_S:
            return False
        # Only one wheel is examined per line, to keep every control step short.
        wheel = self._wheel = (self._wheel + 1) % 4
        mean, jump = self._jumps[wheel], abs(older[wheel] - 2 * before[wheel] + speeds[wheel])
        self._jumps[wheel] = mean = mean + JUMP_GAIN * (elapsed_s / 2 * jump - mean)
        return mean > COARSE


class CountRecovery:
    """Adds the angles in whole counts and the quantization steps to each good line of a port."""

    def __init__(self, counts: int = 0) -> None:
        """Start before the first line.

        `counts` is the configured number of encoder counts per wheel turn, 0 if unknown.
        """
        self._configured, self._whole = counts, WholeCounts(counts)
        self.coarse_lines = 0
        """Number of lines for which `Coarseness` found the examined encoder coarse. Such lines are
        counted only if the counts per turn are not configured."""
        self.forget()

    def forget(self) -> None:
        """Forget all earlier lines, because the board has restarted or was replaced."""
        self._whole.forget()
        self._coarseness = Coarseness()
        self._wheels = tuple(Steps() for _ in NO_STEPS)
        self._reported, self._steps = NO_STEPS, NO_STEPS
        """Quantization step of each wheel, rad/s. `_reported` are the steps that were learned from
        the speeds. `_steps` are the same steps, limited by `MAX_STEP_RATIO`."""

    @property
    def counts(self) -> tuple[int, ...]:
        """Configured encoder counts per turn of each wheel.

        All are 0 if no counts are configured, or if the reported speeds contradict the configured
        counts.
        """
        return (self._configured if self._whole.believed else 0,) * 4

    def recover_counts(self, line: Feedback) -> Feedback:
        """Return a copy of a good line with the fields `counted`, `steps` and `count` set.

        `counted` is None if the angles in whole counts are unknown. If these angles include the
        motion of a missing line before this line, this motion need not be estimated. The field
        `bridged` of the copy is then 0.
        """
        elapsed_s, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if self._whole.angle:
            if line.turned is None and elapsed_s > 0.0:
                counted = self._whole.turned(speeds, elapsed_s, line.bridged)
                if self._whole.covers_gap:
                    line = replace(line, bridged=0.0)
            else:
                self._whole.pause()
        elif elapsed_s > 0.0 and self._coarseness.add(speeds, elapsed_s):
            self.coarse_lines += 1
        a, b, c, d = self._wheels
        a.add(speeds[0])
        b.add(speeds[1])
        c.add(speeds[2])
        d.add(speeds[3])
        reported = a.size, b.size, c.size, d.size
        if reported != self._reported:
            most = MAX_STEP_RATIO * sorted(reported)[2]
            self._reported = reported
            self._steps = min(a.size, most), min(b.size, most), min(c.size, most), min(d.size, most)
        return replace(line, counted=counted, steps=self._steps, count=self._whole.angle)
