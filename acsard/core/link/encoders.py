"""Converts encoder counts into the angle that each motor turned since the previous reading.

The counts are cumulative, so a lost line costs no distance, and the time comes from the board's
clock, so it does not depend on when the host read the lines. Both are modulo 65536. A difference is
used only if the counts cannot have wrapped and a wheel at its highest speed can make it. Otherwise
the caller uses speed times time. The module also detects a probable restart of the board.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from acsard.core.link.minimum_delay import MinimumDelay
from acsard.core.values import NS_PER_S, Ns

SLACK_COUNTS = 4  # one count at each end of the interval, and play in the gears

ROUNDING_MS = 2  # each of the two times is in whole ms

# Excess over the least delay, which then rises; the session restarts after a gap of 1 s.
MAX_DELAY_MS = 1000.0

# No previous reading, or maybe a wrapped count; more than a motor can have turned; a restart.
Unknown = Literal["unknown", "leap", "restarted"]


class Turned(Struct, frozen=True):
    """The angles that the motors a to d turned, rad, and the time by the board's clock, s."""

    motors: Motors
    dt: float


class Encoders:
    def __init__(self, counts: int, wheel_speed: float, quiet_ns: Ns) -> None:
        # A delay `quiet_ns` below the least one is a restart. `counts` is per turn, 0 if unknown.
        self._angle = math.tau / counts if counts else 0.0
        self._fastest = wheel_speed / math.tau * counts / 1000
        self._early_ms = quiet_ns * 1000 / NS_PER_S
        self._last: tuple[Reading, int] | None = None
        # A restart sets the board's clock, modulo 65536 ms, to 0. It then seems to have jumped
        # ahead, and the delay of the next reading seems too small.
        self._promptest = MinimumDelay(most=MAX_DELAY_MS)

    def forget(self) -> None:
        """Forget the previous reading, because a new session begins or a line has no reading."""
        self._last = None

    def turned(self, reading: Reading, at_ns: Ns) -> Turned | Unknown:
        """Return the motion since the previous reading, or why it is unknown.

        `at_ns`, the arrival, serves only to detect a restart or a wrapped count.
        """
        last, self._last = self._last, (reading, at_ns)
        if last is None:
            return "unknown"
        before, before_ns = last
        host_ms = (at_ns - before_ns) * 1000 / NS_PER_S
        mcu_ms = (reading.mcu_ms - before.mcu_ms) % FIELD_VALUES
        if self._promptest.add(host_ms, mcu_ms) < -self._early_ms:
            return "restarted"
        if self._most(max(host_ms, mcu_ms)) >= FIELD_VALUES / 2:
            return "unknown"
        pairs = zip(reading.counts, before.counts, strict=True)
        a, b, c, d = [_signed(now - then) for now, then in pairs]
        if max(abs(a), abs(b), abs(c), abs(d)) > self._most(mcu_ms):
            return "leap"
        angle = self._angle
        return Turned((a * angle, b * angle, c * angle, d * angle), mcu_ms / 1000)

    def _most(self, ms: float) -> float:
        return self._fastest * (ms + ROUNDING_MS) + SLACK_COUNTS


def _signed(difference: int) -> int:
    return (difference + FIELD_VALUES // 2) % FIELD_VALUES - FIELD_VALUES // 2
