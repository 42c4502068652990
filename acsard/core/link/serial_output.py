"""Decides whether a line may be written to the serial port now, and defines the port's interface.

A line is written immediately or dropped, and never queued. The real port and the tests' use this.
"""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.core.config.wire_time import wire_ns
from acsard.core.values import Instant, Ns, Received

# "superseded": dropped, replaced by a stop or only partly written, so the daemon must send a newer
# line. "down": the port is closed.
Offered = Literal["sent", "superseded", "down"]


class Port(Protocol):
    is_open: bool
    opened: int  # how often
    trouble: str  # why the port is closed, in words

    @property
    def sent_ns(self) -> Ns:
        """When the kernel last accepted bytes, 0 since the port was opened."""

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """Return the bytes since the last call; in a `late` step, those in the kernel, too."""

    def release(self, released: bool) -> None:
        """Close the port, and keep it closed for another program, until False opens it again."""

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Write a line (with its end) immediately or drop it. `now` is the step that made it."""


class SerialOutput:
    """The output of a serial port from one opening to its closing."""

    def __init__(self, baud_rate: int, stop: bytes, period_ns: Ns) -> None:
        self._baud_rate, self._stop, self._period_ns = baud_rate, stop, period_ns
        self._still = stop.removesuffix(b"\r\n")  # begin of every stop line
        self.sent_ns = 0  # the kernel last accepted bytes
        self._free_ns = 0
        self._torn = self._first = True

    def prepare(self, line: bytes, made_ns: Ns, now_ns: Ns, kernel_bytes: int) -> bytes | None:
        """Return the bytes for the kernel, or None if the line must be dropped.

        A plain stop replaces the first line. A line end comes first if the board may have got only
        a part of the previous line. A line is dropped if the kernel still has bytes, if the
        previous line was on the wire when this one was made, or if it is older than a period and
        not a stop (the process did not run).
        """
        if kernel_bytes or made_ns < self._free_ns:
            return None
        goes = self._stop if self._first else line
        if now_ns - made_ns > self._period_ns and not goes.startswith(self._still):
            return None
        # The additional line end ends a line of which the board has received only a part.
        return (b"\r\n" if self._torn else b"") + goes

    def record_write(self, line: bytes, handed: bytes, byte_count: int, now_ns: Ns) -> Offered:
        """Record how many bytes of `handed`, which `prepare` made of `line`, the kernel accepted.

        The rest is dropped. Return "superseded" if there is one, or if a stop replaced the line.
        """
        whole = byte_count == len(handed)
        if whole:
            self._first = False
        if byte_count:
            self._torn = not whole
            self.sent_ns = now_ns
            self._free_ns = now_ns + wire_ns(byte_count, self._baud_rate)
        return "sent" if whole and handed.endswith(line) else "superseded"
