"""Encoder counts -> how far each motor has turned since the reading before.

The counts are cumulative, so a lost line loses no distance, and the MCU's own milliseconds are not
bent by when the host read the line. Both are modulo 65536: a difference counts only if it could
not have wrapped and is what the motors can have done. Where it cannot be told, the caller falls
back to speed times time; what looks like an MCU that has restarted is said.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

from acsard.config.wire_time import FIELD
from acsard.mcu.check import Reading
from acsard.mcu.codec import Motors
from acsard.mcu.promptest import Promptest
from acsard.values import NS_PER_S

SLACK_COUNTS = 4
"""Beyond the fastest wheel: a count at each end, and play in the gears."""

ROUNDING_MS = 2
"""What two readings rounded to whole milliseconds may be off."""

LATEST_MS = 1000.0
"""A line that waited longer comes after a gap that starts the session over anyway."""

DRIFT = 0.01
"""By which share the two clocks may go apart; a ceramic resonator has half of it."""

Unknown = Literal["unknown", "leap", "restarted"]
"""Why a difference says nothing: nothing to compare with or too long ago, further than a motor can
have turned, another power-on of the MCU."""


class Turned(Struct, frozen=True):
    """Angles in rad of motors a to d since the reading before, `dt` s ago by the MCU's clock."""

    motors: Motors
    dt: float


class Encoders:
    """Compares each reading with the one before."""

    def __init__(self, counts: int, wheel_speed: float, quiet_ns: int) -> None:
        """`counts` per turn; `wheel_speed` rad/s is the fastest a wheel can turn.

        No reading is read before it was made: by the MCU's clock no more time can have passed than
        by the host's, but for how late the last one was read. That is known to `quiet_ns`.
        """
        self._angle = math.tau / counts if counts else 0.0
        self._fastest = wheel_speed / math.tau * counts / 1000
        self._early_ms = quiet_ns * 1000 / NS_PER_S
        self._last: tuple[Reading, int] | None = None
        self._promptest = Promptest(DRIFT, LATEST_MS)
        """In ms: which reading was read soonest after it was made."""

    def forget(self) -> None:
        """The next reading is a first one: what came before is of another run or accounted for."""
        self._last = None

    def turned(self, reading: Reading, at_ns: int) -> Turned | Unknown:
        """How far the motors turned since the last reading, or why that cannot be told.

        `at_ns` is the host's time of the reading, only to tell a restart and a wrap.
        """
        last, self._last = self._last, (reading, at_ns)
        if last is None:
            return "unknown"
        before, before_ns = last
        host_ms = (at_ns - before_ns) * 1000 / NS_PER_S
        mcu_ms = (reading.mcu_ms - before.mcu_ms) % FIELD
        if self._promptest.add(host_ms, mcu_ms) < -self._early_ms:
            return "restarted"
        if self._most(max(host_ms, mcu_ms)) >= FIELD / 2:
            return "unknown"
        pairs = zip(reading.counts, before.counts, strict=True)
        a, b, c, d = (_signed(now - then) for now, then in pairs)
        if max(abs(a), abs(b), abs(c), abs(d)) > self._most(mcu_ms):
            return "leap"
        angle = self._angle
        return Turned((a * angle, b * angle, c * angle, d * angle), mcu_ms / 1000)

    def _most(self, ms: float) -> float:
        """Counts that no wheel exceeds in so many milliseconds."""
        return self._fastest * (ms + ROUNDING_MS) + SLACK_COUNTS


def _signed(difference: int) -> int:
    """The difference of two counters modulo 65536, nearest to 0."""
    return (difference + FIELD // 2) % FIELD - FIELD // 2
