"""Decides whether a line may go to the serial port now, and defines the interface of the port.

`SerialOutput` is used by the real port (`daemon/serial/port.py`) and by the virtual one of the
tests. A line goes now or not at all.
"""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.core.config.wire_time import wire_ns
from acsard.core.values import Instant, Received

Offered = Literal["sent", "superseded", "down"]
"""What happened to a line: it was sent, it is dropped for a newer one, or the port is closed."""


class Port(Protocol):
    """The interface between the control loop and the serial port."""

    is_open: bool
    opened: int
    """Number of times that the port was opened."""
    trouble: str
    """Reason why the port is closed, in words."""

    @property
    def sent_ns(self) -> int:
        """Monotonic time at which the kernel took the last line, ns."""

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """Return the bytes received since the last call.

        `late` is the time of a step that comes late, or None. With it, bytes that still wait in the
        kernel are read first.
        """

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send a line that was made at `now`, and return whether it was sent.

        A line that is not sent is dropped.
        """


class SerialOutput:
    """The output of a serial port from its opening to its closing. It never keeps a line."""

    def __init__(self, baud_rate: int, stop: bytes, period_ns: int) -> None:
        """Start. `stop` is the plain stop line. A line older than `period_ns` is superseded."""
        self._baud_rate, self._stop, self._period_ns = baud_rate, stop, period_ns
        self._still = stop.removesuffix(b"\r\n")
        """The begin of every stop line, plain or checked."""
        self.sent_ns = 0
        """Monotonic time at which the kernel took the last line, ns."""
        self._free_ns = 0
        self._torn = self._first = True

    def prepare(self, line: bytes, made_ns: int, now_ns: int, kernel_bytes: int) -> bytes | None:
        """Return the bytes to pass to the kernel for a line, or None if the line is superseded.

        A line is superseded for each of these reasons:

        - The kernel still has bytes to send.
        - The line before is still on the wire.
        - The line is older than a period, because the process did not run. A stop is never too old.

        The first line after the port was opened is always a plain stop.

        Args:
            line: the line.
            made_ns: the monotonic time at which the step that made the line began, ns.
            now_ns: the present monotonic time, ns.
            kernel_bytes: the number of bytes that the kernel has not sent yet.
        """
        if kernel_bytes or made_ns < self._free_ns:
            return None
        goes = self._stop if self._first else line
        if now_ns - made_ns > self._period_ns and not goes.startswith(self._still):
            return None
        # A line end in front ends a line of which the board has received only a part.
        return (b"\r\n" if self._torn else b"") + goes

    def took(self, line: bytes, handed: bytes, taken: int, now_ns: int) -> Offered:
        """Take note that the kernel took the first `taken` of the bytes `handed` for `line`.

        Returns "sent" if it took the whole line. The remaining bytes are dropped.
        """
        whole = taken == len(handed)
        if whole:
            self._first = False
        if taken:
            self._torn = not whole
            self.sent_ns = now_ns
            self._free_ns = now_ns + wire_ns(taken, self._baud_rate)
        return "sent" if whole and handed.endswith(line) else "superseded"
