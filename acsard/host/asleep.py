"""Detects that this computer was suspended, while the daemon's monotonic clock stood still.

Without this check, commands and wheel speeds from before the suspend would seem fresh.
"""

from __future__ import annotations

from collections.abc import Callable

from acsard.host.clock import asleep_ns

MOMENT_NS = 100_000_000
"""Shortest time that counts as a suspend, ns. A suspend takes longer, and a step of the wall
clock by NTP does not change the measured time.
"""


class Asleep:
    """Detector that reports each suspend once."""

    def __init__(self, read: Callable[[], int] = asleep_ns) -> None:
        """Use `read`, which returns how long the computer was suspended since its start, ns."""
        self._read, self._known_ns = read, read()

    def was(self) -> bool:
        """Return whether the computer has been suspended since the last call."""
        if self._read() - self._known_ns < MOMENT_NS:
            return False
        # `read` reads two clocks, and another process may have run between them. A second reading
        # confirms the suspend.
        now_ns = self._read()
        slept, self._known_ns = now_ns - self._known_ns >= MOMENT_NS, now_ns
        return slept
