"""Decides when a line may go down the wire, and defines the port as the control loop sees it.

`Gate` serves the real port (`daemon/serial/port.py`) and the tests' virtual one. A line goes now or
not at all (invariant 3).
"""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.core.config.wire_time import wire_ns
from acsard.core.values import Instant, Received

Offered = Literal["sent", "superseded", "down"]


class Port(Protocol):
    """The serial port as the control loop sees it."""

    is_open: bool
    opened: int
    trouble: str

    @property
    def sent_ns(self) -> int:
        """Monotonic time at which the last line was handed over."""

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """Return the bytes received since the last call.

        A step that comes late passes its time as `late`. Then waiting bytes that no reader has read
        yet are included.
        """

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line made at `now`, or report that it did not go.

        The line is never kept for later.
        """


class Gate:
    """The output side of one opening of a port. It never keeps a line."""

    def __init__(self, baud_rate: int, stop: bytes, period_ns: int) -> None:
        """Start; `stop` is the plain stop line. A line older than `period_ns` is superseded."""
        self._baud_rate, self._stop, self._period_ns = baud_rate, stop, period_ns
        self._still = stop.removesuffix(b"\r\n")
        """The start of every stop line, plain or sealed."""
        self.sent_ns = 0
        """Monotonic time at which the last line was handed over."""
        self._free_ns = 0
        self._torn = self._first = True

    def prepare(self, line: bytes, made_ns: int, now_ns: int, kernel_bytes: int) -> bytes | None:
        """Return the bytes to hand to the kernel for a line, or None if the line is superseded.

        The line is superseded if the kernel still holds bytes, if the line before is still on the
        wire, or if the process stood still since `made_ns`, the start of the step, so that the line
        is old. A stop of any form is never too old. The first line of an opening is always a plain
        stop.
        """
        if kernel_bytes or made_ns < self._free_ns:
            return None
        goes = self._stop if self._first else line
        if now_ns - made_ns > self._period_ns and not goes.startswith(self._still):
            return None
        # The end of line in front terminates whatever the board received before, or a torn line.
        return (b"\r\n" if self._torn else b"") + goes

    def took(self, line: bytes, handed: bytes, taken: int, now_ns: int) -> Offered:
        """Note that the kernel took `taken` of the bytes `handed` for `line`.

        The rest is dropped.
        """
        whole = taken == len(handed)
        if whole:
            self._first = False
        if taken:
            self._torn = not whole
            self.sent_ns = now_ns
            self._free_ns = now_ns + wire_ns(taken, self._baud_rate)
        return "sent" if whole and handed.endswith(line) else "superseded"
