"""Converts the board's encoder counts into angles, and compares these with the speeds of the lines.

The counts are cumulative, so a lost line costs no distance, and the time comes from the board's
clock, so it does not depend on when the host read the lines. Both are modulo 65536. A difference is
used only if the counts cannot have wrapped and a wheel at its highest speed can make it. Otherwise
the caller uses speed times time. The module also detects a probable restart of the board.

The firmware computes counts and speeds from the same edges, so they differ only if
`mcu.encoder_counts` is wrong. Then the pose uses the speeds, and the difference until then becomes
a doubt, which the covariance contains.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from acsard.core.link.line_times import MAX_CLOCK_ERROR
from acsard.core.link.link_setup import LinkSetup
from acsard.core.values import Ns, Wheels4

SLACK_COUNTS = 4  # one count at each end of the interval, and play in the gears

NS_PER_MS = 1_000_000

ROUNDING_MS = 2  # each of the two times is in whole ms

# Excess over the least delay, which then rises; the session restarts after a gap of 1 s.
MAX_DELAY_MS = 1000.0

# Driving in the windows of `CountsCheck`, s; the first is short, so that wrong counts move the pose
# little.
WINDOW_S, FIRST_S = 1.0, 0.1

MAX_DIFFERENCE = 0.2  # relative

MIN_COUNTS = 40  # of all wheels in a window: fewer are wrong by their edges

NONE: Wheels4 = (0.0, 0.0, 0.0, 0.0)

# Windows in a row that differ. In one, firmware that filters its speeds may have sped up.
WRONG_WINDOWS = 2

# No previous reading, or maybe a wrapped count; more than a motor can have turned; a restart.
Unknown = Literal["unknown", "leap", "restarted"]


class Turned(Struct, frozen=True):
    """The angles that the motors turned, rad, and the time by the board's clock, s."""

    motors: Motors
    dt: float


class Encoders(Struct):
    last: Reading | None = None
    last_ns: Ns = 0  # its arrival
    # Delay of the last reading over the least one, ms. A restart sets the board's clock, modulo
    # 65536 ms, to 0: it then seems to have jumped ahead, and the delay seems too small.
    late_ms: float = 0.0

    def forget(self) -> None:
        """Forget the previous reading, because a new session begins or a line has no reading."""
        self.last = None

    def turned(self, setup: LinkSetup, reading: Reading, at_ns: Ns) -> Turned | Unknown:
        """Return the motion since the previous reading, or why it is unknown.

        `at_ns`, the arrival, serves only to detect a restart or a wrapped count.
        """
        before, self.last = self.last, reading
        host_ms, self.last_ns = (at_ns - self.last_ns) / NS_PER_MS, at_ns
        if before is None:
            return "unknown"
        mcu_ms = (reading.mcu_ms - before.mcu_ms) % FIELD_VALUES
        late_ms = self.late_ms + host_ms - mcu_ms
        self.late_ms = min(max(0.0, late_ms - MAX_CLOCK_ERROR * host_ms), MAX_DELAY_MS)
        if late_ms < -setup.quiet_ns / NS_PER_MS:
            return "restarted"
        if setup.fastest * (max(host_ms, mcu_ms) + ROUNDING_MS) >= FIELD_VALUES / 2 - SLACK_COUNTS:
            return "unknown"
        counts = [_signed(n - was) for n, was in zip(reading.counts, before.counts, strict=True)]
        most = setup.fastest * (mcu_ms + ROUNDING_MS) + SLACK_COUNTS
        if max(counts) > most or min(counts) < -most:
            return "leap"
        return Turned(tuple([n * setup.count for n in counts]), mcu_ms / 1000)


class CountsCheck(Struct):
    agrees: bool = True  # in the last window
    compared: bool = False
    differing: int = 0  # windows in a row
    # In this window: s of driving, and rad of all wheels by the counts and by the speeds.
    seconds: float = 0.0
    counted: float = 0.0
    reported: float = 0.0
    off: Wheels4 = NONE  # by the counts minus by the speeds, rad
    doubt: Wheels4 | None = None  # `off` of a window that ends with the last line and differs

    def add(self, turned: Wheels4, speeds: Wheels4, dt: float, count: float) -> None:
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


def _signed(difference: int) -> int:
    return (difference + FIELD_VALUES // 2) % FIELD_VALUES - FIELD_VALUES // 2
