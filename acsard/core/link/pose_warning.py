"""Finds out whether the pose is far off although all lines are good, and what helps.

A plain line has no number and no counts. So the time of each line is known only to a few ms, and
the wheels' angle in a lost line is guessed. With fine encoders, that costs some mm. With coarse
ones, whose speed jumps from line to line, it costs metres. If their counts are not declared, the
heading drifts even without a loss.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from acsard.core.link.coarse_encoders import JUMP_ANGLE
from acsard.core.link.feedback import Timeline
from acsard.core.link.line_times import NARROW_DEVIATION
from acsard.core.link.link_setup import LinkSetup
from acsard.core.tables.pose_codes import PoseCode

WINDOW_LINES = 500  # 5 s at 100 Hz

MAX_LOST_FRACTION = 0.01

MIN_COARSE_LINES = 50  # of a window, if the counts per turn are not declared


class PoseWarning(Struct):
    code: PoseCode | Literal[""] = ""
    # Good lines, lines behind lost ones, and lines of coarse encoders, at the last comparison.
    lines: int = 0
    gaps: int = 0
    coarse: int = 0
    due_lines: int = WINDOW_LINES  # good lines at the next comparison

    def choose_code(self, setup: LinkSetup, timeline: Timeline, lines: int) -> bool:
        """Choose the code by the last `WINDOW_LINES`, and return whether it has changed."""
        if timeline.counts_check.differs:
            before, self.code = self.code, "counts_and_speeds_differ"
            return before != self.code
        passed = lines - self.lines
        if passed < WINDOW_LINES:
            return False
        undeclared = timeline.coarse.lines - self.coarse >= MIN_COARSE_LINES
        coarse = undeclared or setup.count >= JUMP_ANGLE
        lossy = timeline.gaps - self.gaps > MAX_LOST_FRACTION * passed
        # A free-running board has no delay that matters: its lines are a period apart.
        vague = timeline.prompted.lateness.deviation > NARROW_DEVIATION and not setup.period_ns
        self.lines, self.gaps, self.coarse = lines, timeline.gaps, timeline.coarse.lines
        self.due_lines = lines + WINDOW_LINES
        before = self.code
        if coarse and (lossy or vague) and not setup.mcu.checked:
            self.code = "coarse_encoder"
        else:
            self.code = "encoder_counts_missing" if undeclared else ""
        return before != self.code
