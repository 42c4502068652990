"""Adds to each good line the angles in whole encoder counts, and the quantization of its speeds.

`whole_counts.py` recovers the counts from the speeds if the counts per turn are configured;
otherwise the pose uses speed times time. They are not learned from the speeds: that works only if
the firmware divides by a fixed period, and then speed times time is wrong only by rounding.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.whole_counts import MAX_DOUBT, WholeCounts

MIN_CHANGE = 0.0105  # rad/s; less may be rounding

BLOCK_STEPS = 64  # steps: even rare counts and filtered speeds give three counts in a block

FIRST_STEPS = 24  # for the first `Steps.size`, which may still grow until the end of the block

STEP_RANK = 3  # the third largest, because one damaged line causes two large changes

# Times the second largest among the wheels: random jumps look like quantization.
MAX_STEP_RATIO = 3.0

# Mean jump, rad per line, of an encoder with 200 counts a turn, above which it is coarse; gain.
COARSE, JUMP_GAIN = 0.015, 0.06

MAX_INTERVAL_S = 0.03  # over a longer time, accelerations look like jumps

NO_STEPS = (0.0, 0.0, 0.0, 0.0)


class Steps:
    """The size of the steps that an encoder causes in the reported speed of its wheel, rad/s.

    One count in a period T changes the speed by 2 pi / (counts per turn x T): 31 rad/s at 20 counts
    and 100 Hz. It is learned from the speeds, so it is right even if the firmware filters them or
    divides by its nominal period. It is inf before `FIRST_STEPS` steps.
    """

    def __init__(self) -> None:
        self.size = math.inf
        self._before = math.inf
        self._last = 0.0
        self._largest = [0.0] * STEP_RANK
        self._count = 0

    def add(self, speed: float) -> None:
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
            self._before, self._count = largest[0], 0
            self.size, self._largest = self._before, [0.0] * STEP_RANK


class Coarseness:
    """Detects wheel speeds that jump back and forth from line to line, as with coarse encoders.

    The jump of speeds v0, v1, v2 in successive lines is |v0 - 2 v1 + v2| dt / 2. A change of the
    acceleration causes one, too, but only in one line.
    """

    def __init__(self) -> None:
        self._rows = NO_STEPS, NO_STEPS
        self._jumps, self._wheel = [0.0] * 4, 0  # rad per line; the wheel of the last line

    def add(self, speeds: Motors, elapsed_s: float) -> bool:
        """Return whether the encoder is coarse that it is the turn of, by the speeds of a line.

        Return False after more than `MAX_INTERVAL_S`, or if all speeds were and are 0.
        """
        (older, before), self._rows = self._rows, (self._rows[1], speeds)
        if speeds == NO_STEPS == before or elapsed_s > MAX_INTERVAL_S:
            return False
        # One wheel per line keeps every control step short.
        wheel = self._wheel = (self._wheel + 1) % 4
        mean, jump = self._jumps[wheel], abs(older[wheel] - 2 * before[wheel] + speeds[wheel])
        self._jumps[wheel] = mean = mean + JUMP_GAIN * (elapsed_s / 2 * jump - mean)
        return mean > COARSE


class CountRecovery:
    def __init__(self, counts: int = 0) -> None:
        self._configured, self._whole = counts, WholeCounts()
        self._angle = math.tau / counts if counts else 0.0
        self.coarse_lines = 0  # with a coarse encoder and no configured counts
        self.forget()

    def forget(self) -> None:
        """Forget all earlier lines: the board has restarted or was replaced."""
        self._whole = WholeCounts()
        self._coarseness = Coarseness()
        self._wheels = tuple(Steps() for _ in NO_STEPS)
        self._reported, self._steps = NO_STEPS, NO_STEPS  # learned, and limited by `MAX_STEP_RATIO`

    @property
    def counts(self) -> tuple[int, ...]:
        """Configured counts per turn; all 0 without them, or if the speeds contradict them."""
        return (self._configured if self._whole.doubt < MAX_DOUBT else 0,) * 4

    def recover_counts(self, line: Feedback) -> Feedback:
        """Return a good line with `counted`, `steps` and `count`.

        If the counts include the motion of a missing line before it, `bridged` becomes 0.
        """
        elapsed_s, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if self._angle:
            if line.turned is None and elapsed_s > 0.0:
                counted = self._whole.turned(
                    self._angle, speeds, elapsed_s, line.jitter, line.bridged
                )
                if self._whole.covers_gap:
                    line = replace(line, bridged=0.0)
            else:
                self._whole.apart = 0.0
            # One count is a step of this size; none is learned.
            step = self._angle / elapsed_s if elapsed_s > 0.0 else 0.0
            return replace(line, counted=counted, steps=(step, step, step, step), count=self._angle)
        if elapsed_s > 0.0 and self._coarseness.add(speeds, elapsed_s):
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
        return replace(line, steps=self._steps)
