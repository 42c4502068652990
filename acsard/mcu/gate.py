"""When a line may go down the wire, and the serial port as the control loop sees it.

`Gate` decides for the real port (`serial/port.py`) and for the tests' virtual one: a line goes now
or not at all (invariant 3).
"""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.config.wire_time import wire_ns
from acsard.values import Instant, Received

Offered = Literal["sent", "superseded", "down"]


class Port(Protocol):
    """The serial port as the loop sees it."""

    is_open: bool
    opened: int
    trouble: str

    @property
    def sent_ns(self) -> int:
        """When the last line had been handed over, monotonic."""

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """What was received since the last call; with the time of a step that comes late also what
        lies there and nobody had the time to read."""

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line made at `now`, or say that it did not go; it is never kept."""


class Gate:
    """One opening of a port, from the line's side; it never keeps one."""

    def __init__(self, baud_rate: int, stop: bytes, period_ns: int) -> None:
        """`stop` is the plain stop line; a line older than a period has one to supersede it."""
        self._baud_rate, self._stop, self._period_ns = baud_rate, stop, period_ns
        self._still = stop.removesuffix(b"\r\n")
        """What every stop begins with, plain or sealed."""
        self.sent_ns = 0
        """When the last line had been handed over, monotonic."""
        self._free_ns = 0
        self._torn = self._first = True

    def prepare(self, line: bytes, made_ns: int, now_ns: int, kernel_bytes: int) -> bytes | None:
        """What to hand to the kernel now for a line of a step that began at `made_ns`.

        None when it is superseded: the kernel still holds something, the line before is still on
        the wire, or the process stood still in the middle of the step and what it says is old. A
        stop never is, in whatever form. The first line of an opening is a plain stop, whatever is
        wished by then.
        """
        if kernel_bytes or made_ns < self._free_ns:
            return None
        goes = self._stop if self._first else line
        if now_ns - made_ns > self._period_ns and not goes.startswith(self._still):
            return None
        # What the board or a torn line left on the wire ends with an end of line of its own.
        return (b"\r\n" if self._torn else b"") + goes

    def took(self, line: bytes, handed: bytes, taken: int, now_ns: int) -> Offered:
        """The kernel took so many of the bytes handed to it for `line`; the rest is dropped."""
        whole = taken == len(handed)
        if whole:
            self._first = False
        if taken:
            self._torn = not whole
            self.sent_ns = now_ns
            self._free_ns = now_ns + wire_ns(taken, self._baud_rate)
        return "sent" if whole and handed.endswith(line) else "superseded"
