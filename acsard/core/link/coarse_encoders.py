"""Decides whether the encoders of a board whose counts per turn are not declared are coarse.

One count more in a line makes the speed of a wheel jump up, and one less lets it fall again. The
speeds of fine encoders jump only in damaged lines, and a motor rises or falls for longer. The size
of a count is not learned: 200 counts in 10 ms look like 400 in 5 ms, so at 100 lines a second only
less than about 125 counts are found, and below 33 lines a second none.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct, field

from acsard.core.values import Rad, RadPerS, Seconds, Wheels4

COARSEST_COUNT: Rad = 0.393  # of the coarsest expected encoder, with the rounding of its speed

MIN_COUNT_S = 0.004  # boards that are asked more often repeat their speeds

MIN_CHANGE = 0.0105  # rad/s; less may be rounding

# A smaller change is no jump: an angle, and a speed that 400 counts reach only in less than 4 ms.
JUMP_ANGLE, JUMP_SPEED = math.tau / 200, 5.0

# A larger one is damage: no lie excuses itself. A board may count for less than the line's time.
LARGEST_JUMP = 1.5 * COARSEST_COUNT

# By the number of driven wheels: jumps, each in the other direction than the one before, of a wheel
# in a block of `CHANGES` of the speeds of all wheels: fewer are damaged lines. If 5 % of the lines
# have two false values, 0.5 % of the lines of four wheels count as coarse, and 0.6 % of those of
# two (3 % with 3 jumps).
MIN_JUMPS, CHANGES = {4: 3, 2: 5}, 96

# Over a longer time than this, a change of speed may be an acceleration.
MAX_INTERVAL_S = 0.03

NONE: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class CoarseEncoders(Struct):
    found: Literal["", "fine", "coarse"] = ""
    lines: int = 0  # while they were coarse
    speeds: Wheels4 = NONE  # of the last line
    seconds: Seconds = 0.0  # of the last line
    changes: int = 0  # in this block
    # Of each wheel: jumps in this block, and the direction of the last one.
    jumps: list[int] = field(default_factory=lambda: [0] * 4)
    rises: list[bool] = field(default_factory=lambda: [False] * 4)

    def forget(self) -> None:
        """Forget all lines: the board has restarted or was replaced."""
        self.found, self.changes, self.jumps = "", 0, [0] * 4

    def step(self, speeds: Wheels4, elapsed: Seconds, driven: int) -> RadPerS:
        """Add a line, and return a bound of the change of a speed by one count.

        It is inf if unknown, and 0 for fine encoders, whose counts a motor's own changes cover.
        `elapsed` is the time since the line before it, which may have been lost, and `driven` the
        number of driven wheels.
        """
        seconds = elapsed if elapsed > MIN_COUNT_S else MIN_COUNT_S
        fine = JUMP_ANGLE / seconds
        fine = fine if fine > JUMP_SPEED else JUMP_SPEED
        # The counts of either line may cause the change.
        largest = LARGEST_JUMP / (seconds if seconds > self.seconds else self.seconds)
        if speeds != self.speeds:
            self._compare(speeds, fine, largest, MIN_JUMPS[driven])
            self.speeds = speeds
        self.seconds = seconds
        if self.found == "fine":
            return 0.0
        if self.found == "coarse":
            self.lines += 0.0 < elapsed < MAX_INTERVAL_S
            return LARGEST_JUMP / seconds
        return math.inf

    def _compare(self, speeds: Wheels4, least: RadPerS, most: RadPerS, enough: int) -> None:
        jumps, rises = self.jumps, self.rises
        for wheel, (now, before) in enumerate(zip(speeds, self.speeds, strict=True)):
            change = now - before
            size = abs(change)
            if MIN_CHANGE <= size <= most:
                self.changes += 1
                if size > least and (change > 0.0) is not rises[wheel]:
                    rises[wheel] = change > 0.0
                    jumps[wheel] += 1
        # One wheel of four may have a dead encoder, and damaged lines may have two false speeds. Of
        # two, `third` is the one that jumps less, and `second` the other.
        _, third, second, _ = sorted(jumps)
        if third >= enough:
            self.found = "coarse"
        elif second >= enough and self.found == "fine":
            self.found = ""
        if self.changes >= CHANGES:
            if second < enough:
                self.found = "fine"
            self.changes, self.jumps = 0, [0] * 4
