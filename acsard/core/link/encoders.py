"""Converts encoder counts into the angle that each motor turned since the previous reading.

The counts are cumulative, so a lost line costs no distance, and the time comes from the board's
clock, so it does not depend on when the host read the lines. Both are modulo 65536. A difference is
used only if the counts cannot have wrapped and a wheel at its highest speed can make it. Otherwise
the caller uses speed times time. The module also detects a probable restart of the board.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from acsard.core.link.line_times import MAX_CLOCK_ERROR
from acsard.core.link.link_setup import LinkSetup
from acsard.core.values import Ns

SLACK_COUNTS = 4  # one count at each end of the interval, and play in the gears

NS_PER_MS = 1_000_000

ROUNDING_MS = 2  # each of the two times is in whole ms

# Excess over the least delay, which then rises; the session restarts after a gap of 1 s.
MAX_DELAY_MS = 1000.0

# No previous reading, or maybe a wrapped count; more than a motor can have turned; a restart.
Unknown = Literal["unknown", "leap", "restarted"]


class Turned(Struct, frozen=True):
    """The angles that the motors a to d turned, rad, and the time by the board's clock, s."""

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
        a, b, c, d = reading.counts
        was_a, was_b, was_c, was_d = before.counts
        a, b, c, d = _signed(a - was_a), _signed(b - was_b), _signed(c - was_c), _signed(d - was_d)
        most = setup.fastest * (mcu_ms + ROUNDING_MS) + SLACK_COUNTS
        if max(a, b, c, d, -a, -b, -c, -d) > most:
            return "leap"
        angle = setup.count
        return Turned((a * angle, b * angle, c * angle, d * angle), mcu_ms / 1000)


def _signed(difference: int) -> int:
    return (difference + FIELD_VALUES // 2) % FIELD_VALUES - FIELD_VALUES // 2
