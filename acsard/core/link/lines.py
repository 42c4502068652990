"""Splits the serial bytes into lines, with bounded memory. Every newline resynchronizes.

This module knows nothing about the meaning of a line. Lines end with LF or CR LF. Empty ones are
dropped silently, because the daemon starts every session with a bare end of line and an echoing
board may send it back.
"""

from __future__ import annotations

MAX_LINE = 128
"""Bytes of a line with its end. The longest frame has 62, so more is noise without a newline."""


class LineReader:
    """A splitter of a byte stream into lines. The stream may come in any pieces."""

    def __init__(self) -> None:
        self._held = b""
        self._discarding = False
        self.too_long = 0
        """Number of over-long lines that were discarded."""

    def clear(self) -> None:
        """Forget a half-received line, because the port has been reopened."""
        self._held = b""
        self._discarding = False

    def feed(self, data: bytes) -> list[tuple[bytes, int]]:
        """Return the lines that `data` completes, without their ends, in order.

        Each line comes with the number of bytes of `data` that followed it. Those bytes were on the
        wire after the line was complete, so their number tells how long ago that was.
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
