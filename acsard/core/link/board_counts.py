"""Converts the board's encoder counts into angles, and compares these with the speeds of the lines.

The counts are cumulative, so a lost line costs no distance, and the time comes from the board's
clock, so it does not depend on when the host read the lines. Both are modulo 65536. A difference is
used only if the counts cannot have wrapped and a wheel at its highest speed can make it. Otherwise
the caller uses speed times time. The module also detects a probable restart of the board.

The firmware computes counts and speeds from the same edges. If they contradict each other, either
may be wrong: the pose goes on using the counts, and the difference is a doubt, which the covariance
contains (`CountsCheck`).
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from acsard.core.link.line_times import MAX_CLOCK_ERROR
from acsard.core.link.link_setup import LinkSetup
from acsard.core.values import Ns, Wheels4

SLACK_COUNTS = 4  # one count at each end of the interval, and play in the gears

LEAP = 5.0  # times the fastest wheel: less may be a wrong `mcu.encoder_counts`, which is compared

NS_PER_MS = 1_000_000

ROUNDING_MS = 2  # each of the two times is in whole ms

# Excess over the least delay, which then rises; the session restarts after a gap of 1 s.
MAX_DELAY_MS = 1000.0

# Of driving, in a window of `CountsCheck`, and of a wheel. A window without a difference is full
# when it would have shown one of this share: the way there and back is the same by both.
WINDOW_S, WINDOW_ANGLE, WINDOW_SHARE = 5.0, 2 * math.tau, 0.2

# By which the angles of a wheel may differ: a share, counts (one at each end), rad/s by rounding,
# and s by a filter of the speeds, times the change of the speed.
SHARE, EDGES, ROUNDING, FILTER_S = 0.03, 2, 0.005, 0.25

COMPARED_S = 0.1  # between two comparisons
SETTLE_S = 0.5  # from rest to the first window: the speeds of a filter rise later than the counts
IDLE_S = 0.5  # without any motion, between two counts of a coarse encoder

NONE: Wheels4 = (0.0, 0.0, 0.0, 0.0)

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
        most = LEAP * setup.fastest * (mcu_ms + ROUNDING_MS) + SLACK_COUNTS
        if max(counts) > most or min(counts) < -most:
            return "leap"
        return Turned(tuple([n * setup.count for n in counts]), mcu_ms / 1000)


class CountsCheck(Struct):
    differs: bool = False  # in the last window that was full
    # It may in this one, and all wheels by one factor: a wrong setting, and no fault of a wheel.
    scaled: bool = False
    figures: str = ""  # of the window that differs, and its wheel that differs most
    wheel: int = 0
    # In this window: s of driving, rad of each wheel by its counts and by its speeds.
    seconds: float = -SETTLE_S
    counted: Wheels4 = NONE
    reported: Wheels4 = NONE
    doubted: Wheels4 = NONE  # of the difference
    idle_s: float = 0.0  # since the last motion
    begin: Wheels4 = NONE  # speeds, rad/s
    # At the last comparison: the time, and `reported`.
    compared_s: float = -SETTLE_S
    compared: Wheels4 = NONE

    def add(self, turned: Wheels4, speeds: Wheels4, dt: float, count: float) -> Wheels4 | None:
        """Add a line: the angles by its counts, its speeds, and the time by the board's clock.

        Return the difference that is to be doubted, rad, less that of earlier lines.
        """
        if turned == NONE == speeds:
            self.idle_s += dt
            return None
        idle_s, self.idle_s = self.idle_s, 0.0
        seconds = self.seconds = self.seconds + dt + (idle_s if idle_s < IDLE_S else 0.0)
        a, b, c, d = self.counted
        e, f, g, h = turned
        self.counted = a + e, b + f, c + g, d + h
        a, b, c, d = self.reported
        e, f, g, h = speeds
        self.reported = a + e * dt, b + f * dt, c + g * dt, d + h * dt
        since = seconds - self.compared_s
        return self._compare(count, since) if since >= COMPARED_S else None

    def _compare(self, count: float, since: float) -> Wheels4 | None:
        counted, reported, seconds = self.counted, self.reported, self.seconds
        rows = zip(reported, self.compared, strict=True)
        speeds = _wheels4([(now - was) / since for now, was in rows])
        if self.compared_s < 0.0 <= seconds:
            self._begin(speeds)  # of a robot that was at rest
            return None
        self.compared_s, self.compared = seconds, reported
        off = _wheels4([one - other for one, other in zip(counted, reported, strict=True)])
        over, known = 1.0, False
        wheels = zip(off, counted, reported, speeds, self.begin, strict=True)
        for wheel, (difference, one, other, now, then) in enumerate(wheels):
            size = max(abs(one), abs(other))
            most = SHARE * size + EDGES * count + ROUNDING * seconds + FILTER_S * abs(now - then)
            if abs(difference) / most > over:
                over, worst = abs(difference) / most, wheel
            if most < WINDOW_SHARE * size and (wheel == self.wheel or not self.differs):
                known = True
        full = seconds >= WINDOW_S and max(map(abs, counted + reported)) >= WINDOW_ANGLE
        full = full and (known or over > 1.0)
        suspected = over > 1.0 or ((self.differs or self.doubted != NONE) and not full)
        self.scaled = suspected and self._is_scaled(count)
        doubt = None
        if suspected or self.doubted != NONE:
            doubt = _wheels4([now - was for now, was in zip(off, self.doubted, strict=True)])
            self.doubted = off
        if full:
            self.differs, self.figures = over > 1.0, ""
            if self.differs:
                one, other, self.wheel = counted[worst], reported[worst], worst
                self.figures = (
                    f"{one:.1f} rad by its counts and {other:.1f} rad by its speeds in "
                    f"{seconds:.1f} s"
                )
            self._begin(speeds)
        return doubt

    def _is_scaled(self, count: float) -> bool:
        factors = [
            (one / other, SHARE / 2 + EDGES * count / abs(other))
            for one, other in zip(self.counted, self.reported, strict=True)
            if abs(other) > EDGES * count
        ]
        if not factors:
            return self.scaled
        least = max(factor - share * abs(factor) for factor, share in factors)
        return least <= min(factor + share * abs(factor) for factor, share in factors)

    def _begin(self, speeds: Wheels4) -> None:
        self.begin, self.seconds, self.compared_s = speeds, 0.0, 0.0
        self.counted = self.reported = self.doubted = self.compared = NONE


def _wheels4(values: list[float]) -> Wheels4:
    front_right, front_left, rear_left, rear_right = values
    return front_right, front_left, rear_left, rear_right


def _signed(difference: int) -> int:
    return (difference + FIELD_VALUES // 2) % FIELD_VALUES - FIELD_VALUES // 2
