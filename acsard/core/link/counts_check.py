"""Compares the board's counts with the speeds in the same lines.

The firmware computes both from the same edges, so they differ only if `mcu.encoder_counts` is
wrong. Then the pose uses the speeds, and the difference until then is a doubt.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.link.codec import Motors

WINDOW_S = 1.0  # of driving

FIRST_S = 0.1  # the first window: wrong counts are to move the pose little

MAX_DIFFERENCE = 0.2  # relative

MIN_COUNTS = 40  # of all wheels in a window: fewer are wrong by their edges

NONE: Motors = (0.0, 0.0, 0.0, 0.0)

# Windows in a row that differ. In one, firmware that filters its speeds may have sped up.
WRONG_WINDOWS = 2


class CountsCheck(Struct):
    agrees: bool = True  # in the last window
    compared: bool = False
    differing: int = 0  # windows in a row
    # In this window: s of driving, and rad of all wheels by the counts and by the speeds.
    seconds: float = 0.0
    counted: float = 0.0
    reported: float = 0.0
    off: Motors = NONE  # by the counts minus by the speeds, rad
    doubt: Motors | None = None  # `off` of a window that ends with the last line and differs

    def add(self, turned: Motors, speeds: Motors, dt: float, count: float) -> None:
        """Add a line: the angles by its counts, its speeds, and the time by the board's clock."""
        a, b, c, d = turned
        e, f, g, h = speeds
        counted = abs(a) + abs(b) + abs(c) + abs(d)
        reported = (abs(e) + abs(f) + abs(g) + abs(h)) * dt
        if not counted and not reported:
            return
        self.seconds += dt
        self.counted += counted
        self.reported += reported
        off_a, off_b, off_c, off_d = self.off
        self.off = (
            off_a + a - e * dt, off_b + b - f * dt, off_c + c - g * dt, off_d + d - h * dt,
        )  # fmt: skip
        window_s = WINDOW_S if self.compared else FIRST_S
        if self.seconds >= window_s and max(self.counted, self.reported) >= MIN_COUNTS * count:
            off = abs(self.counted - self.reported)
            self.compared, used = True, self.agrees
            self.agrees = off <= MAX_DIFFERENCE * self.reported
            if used and not self.agrees:
                self.doubt = self.off
            self.differing = 0 if self.agrees else self.differing + 1
            self.seconds, self.counted, self.reported, self.off = 0.0, 0.0, 0.0, NONE

    @property
    def wrong(self) -> bool:
        """Whether the configured number of counts is wrong."""
        return self.differing >= WRONG_WINDOWS
