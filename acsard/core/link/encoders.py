"""Converts encoder counts into the angle that each motor turned since the previous reading.

The counts are cumulative, so no distance is missing after a lost line. The board sends the time of
its own clock with the counts. The time between two readings therefore does not depend on when the
host read the lines. Counts and milliseconds are modulo 65536. The difference between two counts is
used only in this case: the counts cannot have wrapped, and a wheel at its highest speed can make
that many counts. Otherwise the caller computes the angle as speed times time. The module also
detects a probable restart of the board.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from acsard.core.link.minimum_delay import MinimumDelay
from acsard.core.values import NS_PER_S

SLACK_COUNTS = 4
"""Margin on the largest plausible number of counts between two readings, in counts. This largest
number follows from the highest speed of a wheel. The margin covers one count at each end of the
interval, and play in the gears."""

ROUNDING_MS = 2
"""Largest error of the time between two readings, ms. The time of each reading is in whole ms, so
it is wrong by up to 1 ms."""

MAX_DELAY_MS = 1000.0
"""Largest excess of a reading's delay over the least delay so far, ms. The delay is the arrival
time of the reading minus its time by the board's clock. If the excess is larger, the least delay
rises. A larger limit is not needed, because the session restarts after a gap of one second."""

Unknown = Literal["unknown", "leap", "restarted"]
"""The reason why the angles since the previous reading of the encoders are unknown.

- unknown: there is no previous reading, or it is so old that a count may have wrapped
- leap: the difference between the counts is more than any motor can have turned
- restarted: the board has probably restarted
"""


class Turned(Struct, frozen=True):
    """The motion between two readings of the encoders.

    `motors` are the angles that the motors a to d turned, rad. `dt` is the time between the two
    readings by the board's clock, s.
    """

    motors: Motors
    dt: float


class Encoders:
    """Converts each reading of the encoders to the angles turned since the previous reading."""

    def __init__(self, counts: int, wheel_speed: float, quiet_ns: int) -> None:
        """Prepare for the first reading of the encoders.

        Args:
            counts: encoder counts per wheel turn, 0 if unknown.
            wheel_speed: highest speed of a wheel, rad/s.
            quiet_ns: time without a line from the board after which the link is stale, ns. The
                delay of a reading is its arrival time minus its time by the board's clock. If the
                delay is more than `quiet_ns` below the least delay so far, the board has probably
                restarted.
        """
        self._angle = math.tau / counts if counts else 0.0
        self._fastest = wheel_speed / math.tau * counts / 1000
        self._early_ms = quiet_ns * 1000 / NS_PER_S
        self._last: tuple[Reading, int] | None = None
        # A restart sets the board's clock to 0. The clock counts modulo 65536 ms, so it then seems
        # to have jumped ahead, and the delay of the next reading seems too small.
        self._promptest = MinimumDelay(most=MAX_DELAY_MS)
        """Measures the delay of each reading in excess of the least delay so far, ms. The delay is
        the arrival time of the reading minus its time by the board's clock."""

    def forget(self) -> None:
        """Forget the previous reading, because a new session begins or a line has no reading."""
        self._last = None

    def turned(self, reading: Reading, at_ns: int) -> Turned | Unknown:
        """Return the motion since the previous reading, or the reason why the motion is unknown.

        `at_ns` is the monotonic time at which the reading arrived, ns. It serves only to detect
        that the board has restarted, or that a count may have wrapped.
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
