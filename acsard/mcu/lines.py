"""Serial bytes -> lines. Bounded memory; the next newline always resynchronises.

Knows nothing of what a line means. Lines end with LF or CR LF; empty ones are dropped silently
(we start every session with a bare end of line, and an echoing MCU may send it back).
"""

from __future__ import annotations

MAX_LINE = 128
"""Bytes of a line with its end; the longest frame has 62, so more is noise without newline."""


class LineReader:
    """Cuts a byte stream into lines, fed in any pieces."""

    def __init__(self) -> None:
        self._held = b""
        self._discarding = False
        self.too_long = 0
        """How many over-long lines have been thrown away."""

    def clear(self) -> None:
        """Forget a half-received line (the port has been reopened)."""
        self._held = b""
        self._discarding = False

    def feed(self, data: bytes) -> list[tuple[bytes, int]]:
        """The lines that `data` completes, without their ends, in order.

        With each comes the number of bytes of `data` that followed it: those were on the wire
        after the line was complete, so they tell how long ago that was.
        """
        lines = []
        ends = data.split(b"\n")
        rest = ends.pop()
        following = len(data)
        for piece in ends:
            following -= len(piece) + 1
            line = self._held + piece
            self._held = b""
            if self._discarding:
                self._discarding = False
            elif len(line) >= MAX_LINE:
                self.too_long += 1
            elif line not in (b"", b"\r"):
                lines.append((line.removesuffix(b"\r"), following))
        if not self._discarding:
            self._held += rest
            if len(self._held) >= MAX_LINE:
                self.too_long += 1
                self._held = b""
                self._discarding = True
        return lines
