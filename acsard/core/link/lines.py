"""Splits the bytes from the serial port into lines, with bounded memory.

Lines end with LF or CR LF. This module does not interpret their content. After noise, the next LF
ends the damaged line, and a new line begins. Empty lines are dropped silently: the daemon starts
every session with a bare line end, and a board that echoes may send it back.
"""

from __future__ import annotations

MAX_LINE_BYTES = 128
"""Largest number of bytes in a line, including its line end. A reply has about 62 bytes, and a
status line with all fields about 100."""


class LineReader:
    """A splitter that turns a stream of received bytes, in pieces of any size, into lines."""

    def __init__(self) -> None:
        self._held = b""
        self._discarding = False
        self.too_long = 0

    def clear(self) -> None:
        """Forget the beginning of an incomplete line, because the port has been reopened."""
        self._held = b""
        self._discarding = False

    def feed(self, data: bytes) -> list[tuple[bytes, int]]:
        """Add the received bytes `data`, and return the lines that they complete, in order.

        Each item is a pair: the line without its line end, and the number of bytes in `data` after
        the line. The wire needs a known time for these bytes, so the caller can compute when the
        line was complete.
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
            elif len(line) >= MAX_LINE_BYTES:
                self.too_long += 1
            elif line not in (b"", b"\r"):
                lines.append((line.removesuffix(b"\r"), following))
        if not self._discarding:
            self._held += rest
            if len(self._held) >= MAX_LINE_BYTES:
                self.too_long += 1
                self._held = b""
                self._discarding = True
        return lines
