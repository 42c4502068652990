"""Adds to each good line the angles in whole encoder counts, and the quantization of its speeds.

`whole_counts.py` recovers the counts from the speeds if the counts per turn are configured;
otherwise the pose uses speed times time. They are not learned from the speeds: that works only if
the firmware divides by a fixed period, and then speed times time is wrong only by rounding.
"""

from __future__ import annotations

import math

from msgspec import Struct, field
from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.whole_counts import MAX_DOUBT, WholeCounts
from acsard.core.values import Rad, Seconds

MIN_CHANGE = 0.0105  # rad/s; less may be rounding

BLOCK_STEPS = 64  # steps: even rare counts and filtered speeds give three counts in a block

FIRST_STEPS = 24  # for the first `Steps.size`, which may still grow until the end of the block

STEP_RANK = 3  # the third largest, because one damaged line causes two large changes

# Times the second largest among the wheels: random jumps look like quantization.
MAX_STEP_RATIO = 3.0

# Of a count. Over a longer time than this, a change of speed is an acceleration.
COARSE_ANGLE, MAX_INTERVAL_S = math.tau / 200, 0.03

# Of the coarsest expected encoder, rad, with the rounding of its speed.
COARSEST_COUNT = 0.393

# In the largest change that teaches, because a board may count for less than the line's time.
LARGEST_STEP = 1.5 * COARSEST_COUNT

MIN_COUNT_S = 0.004  # boards that are asked more often repeat their speeds

UNKNOWN = (math.inf,) * 4


class Steps(Struct):
    """The size of the steps that an encoder causes in the reported speed of its wheel, rad/s.

    One count in a period T changes the speed by 2 pi / (counts per turn x T): 31 rad/s at 20 counts
    and 100 Hz. It is learned from the speeds, so it is right even if the firmware filters them or
    divides by its nominal period. A change that not even the coarsest encoder causes teaches
    nothing, so no lie excuses itself. It is inf before `FIRST_STEPS` steps.
    """

    size: float = math.inf
    last: float = 0.0  # speed
    largest: list[float] = field(default_factory=lambda: [0.0] * STEP_RANK)  # in this block
    count: int = 0

    def add(self, speed: float, limit: float) -> None:
        step = abs(speed - self.last)
        if step < MIN_CHANGE:
            return
        self.last = speed
        if step > limit:
            return
        largest = self.largest
        if step > largest[0]:
            largest[0] = step
            largest.sort()
            if largest[0] > self.size:
                self.size = largest[0]
        self.count += 1
        if self.count == FIRST_STEPS and self.size == math.inf:
            self.size = largest[0]
        if self.count == BLOCK_STEPS:
            self.size, self.count = largest[0], 0
            self.largest = [0.0] * STEP_RANK


def _unknown() -> tuple[Steps, Steps, Steps, Steps]:
    return Steps(), Steps(), Steps(), Steps()


class CountRecovery(Struct):
    whole: WholeCounts = field(default_factory=WholeCounts)
    wheels: tuple[Steps, Steps, Steps, Steps] = field(default_factory=_unknown)
    learned: Motors = UNKNOWN
    steps: Motors = UNKNOWN  # limited by `MAX_STEP_RATIO`
    elapsed_s: Seconds = 0.0  # of the last line
    coarse_lines: int = 0  # with a coarse encoder and no configured counts

    def forget(self) -> None:
        """Forget all earlier lines: the board has restarted or was replaced."""
        self.whole, self.wheels = WholeCounts(), _unknown()
        self.learned = self.steps = UNKNOWN

    def counts(self, configured: int) -> tuple[int, ...]:
        """Return the configured counts per turn; all 0 if the speeds contradict them."""
        return (configured if self.whole.doubt < MAX_DOUBT else 0,) * 4

    def recover_counts(self, line: Feedback, angle: Rad, shown: bool = True) -> Feedback:
        """Return a good line with `counted`, `steps` and `count`.

        `angle` is that of one count, rad, or 0 if the counts are not configured; `shown`: the
        speeds show whole counts. If these include the motion of a missing line before it, `bridged`
        becomes 0.
        """
        elapsed_s, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if angle:
            if line.turned is None and elapsed_s > 0.0 and shown:
                counted = self.whole.turned(angle, speeds, elapsed_s, line.jitter, line.bridged)
                if self.whole.covers_gap:
                    line = replace(line, bridged=0.0)
            else:
                self.whole.apart = 0.0
            # One count is a step of this size; none is learned.
            step = angle / elapsed_s if elapsed_s > 0.0 else 0.0
            return replace(line, counted=counted, steps=(step, step, step, step), count=angle)
        # The counts of either line may cause the change.
        limit = LARGEST_STEP / max(elapsed_s, self.elapsed_s, MIN_COUNT_S)
        self.elapsed_s = elapsed_s
        a, b, c, d = self.wheels
        a.add(speeds[0], limit)
        b.add(speeds[1], limit)
        c.add(speeds[2], limit)
        d.add(speeds[3], limit)
        reported = a.size, b.size, c.size, d.size
        if reported != self.learned:
            most = MAX_STEP_RATIO * sorted(reported)[2]
            self.learned = reported
            self.steps = min(a.size, most), min(b.size, most), min(c.size, most), min(d.size, most)
        if elapsed_s < MAX_INTERVAL_S and COARSE_ANGLE < max(self.steps) * elapsed_s < math.inf:
            self.coarse_lines += 1
        return replace(line, steps=self.steps)
