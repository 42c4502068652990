"""The serial port as the control loop sees it; `serial/port.py` is the real one."""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.values import Instant, Received

Offered = Literal["sent", "superseded", "down"]


class Port(Protocol):
    """The serial port as the loop sees it."""

    is_open: bool
    opened: int
    trouble: str
    sent_ns: int
    """When the last line had been handed over, monotonic."""

    def take(self) -> tuple[Received, ...]:
        """What was received since the last call."""

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line now or not at all."""
