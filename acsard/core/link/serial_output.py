"""Decides whether a line may be written to the serial port now, and defines the port's interface.

The real port (`daemon/serial/port.py`) and the virtual port of the tests use `SerialOutput`. A line
is written immediately or dropped. It is never queued.
"""

from __future__ import annotations

from typing import Literal, Protocol

from acsard.core.config.wire_time import wire_ns
from acsard.core.values import Instant, Received

Offered = Literal["sent", "superseded", "down"]
"""The result of `Port.offer`. "sent" means that the port wrote the complete line. "superseded"
means that the line was dropped, replaced by a stop or only partly written, so that the daemon must
send a newer line. "down" means that the port is closed."""


class Port(Protocol):
    """The interface between the control loop and the serial port."""

    is_open: bool
    opened: int
    """Number of times that the port was opened."""
    trouble: str
    """Reason why the port is closed, in words."""

    @property
    def sent_ns(self) -> int:
        """Monotonic time at which the kernel last accepted bytes, ns."""

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """Return the bytes received since the last call.

        `late` is the time of the control step if the step is late, else None. In a late step, the
        port also reads the bytes that still wait in the kernel.
        """

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Write a line immediately or drop it, and return the result.

        `line` has a line end. `now` is the time of the control step that made the line.
        """


class SerialOutput:
    """The output of a serial port while it is open. Each opening of the port needs a new object."""

    def __init__(self, baud_rate: int, stop: bytes, period_ns: int) -> None:
        """Start for a port that was just opened.

        `stop` is the plain line that commands speed zero for all wheels. `period_ns` is the control
        period, ns: `prepare` drops a line that is older, unless it is a stop.
        """
        self._baud_rate, self._stop, self._period_ns = baud_rate, stop, period_ns
        self._still = stop.removesuffix(b"\r\n")
        """The bytes with which every stop line begins, plain or checked."""
        self.sent_ns = 0
        """Monotonic time at which the kernel last accepted bytes, ns."""
        self._free_ns = 0
        self._torn = self._first = True

    def prepare(self, line: bytes, made_ns: int, now_ns: int, kernel_bytes: int) -> bytes | None:
        """Return the bytes to pass to the kernel for a line, or None if the line must be dropped.

        The first line after the port was opened is replaced by a plain stop, which commands speed
        zero for all wheels. If the board may have received only a part of the previous line, the
        bytes begin with an additional line end. A line is dropped in these cases:

        - The kernel still has bytes to send.
        - The previous line was still on the wire when this line was made.
        - The line is older than a period and is not a stop. This happens if the process did not run
          meanwhile.

        Args:
            line: the line with its line end.
            made_ns: monotonic time at which the step that made the line began, ns.
            now_ns: present monotonic time, ns.
            kernel_bytes: number of bytes that the kernel has not sent yet.
        """
        if kernel_bytes or made_ns < self._free_ns:
            return None
        goes = self._stop if self._first else line
        if now_ns - made_ns > self._period_ns and not goes.startswith(self._still):
            return None
        # The additional line end ends a line of which the board has received only a part.
        return (b"\r\n" if self._torn else b"") + goes

    def record_write(self, line: bytes, handed: bytes, byte_count: int, now_ns: int) -> Offered:
        """Record that the kernel accepted `byte_count` bytes of `handed`, and return the result.

        `handed` are the bytes that `prepare` returned for `line`. The result is "superseded" if the
        kernel did not accept all of these bytes, or if `prepare` replaced the line with a stop.
        Otherwise the result is "sent". Bytes that the kernel did not accept are dropped.
        """
        whole = byte_count == len(handed)
        if whole:
            self._first = False
        if byte_count:
            self._torn = not whole
            self.sent_ns = now_ns
            self._free_ns = now_ns + wire_ns(byte_count, self._baud_rate)
        return "sent" if whole and handed.endswith(line) else "superseded"
