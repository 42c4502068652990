"""When the wire is free for a line: the rule "we hold no line back" (invariant 3).

Shared by the real port and by the tests' virtual one.
"""

from __future__ import annotations

from acsard.config.baud import wire_ns


class LineGate:
    """Decides whether a line may be offered to the kernel now; it never keeps one."""

    def __init__(self, baud_rate: int) -> None:
        self._baud_rate = baud_rate
        self._free_ns = 0
        self._torn = True
        self.first = True
        """No whole line has gone yet: the next one must be zeros, whatever is wished by then."""

    def may_send(self, now_ns: int, kernel_bytes: int) -> bool:
        """True when the kernel holds nothing and the previous line has left the wire."""
        return kernel_bytes == 0 and now_ns >= self._free_ns

    @property
    def prefix(self) -> bytes:
        """What must precede the next line: an end of line after a torn line and after opening."""
        return b"\r\n" if self._torn else b""

    def note_sent(self, now_ns: int, offered: int, taken: int) -> None:
        """Record that the kernel took `taken` of `offered` bytes; the rest is dropped."""
        if taken:
            self._torn = taken < offered
        if taken == offered:
            self.first = False
        self._free_ns = now_ns + wire_ns(taken, self._baud_rate)
