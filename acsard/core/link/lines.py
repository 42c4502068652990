"""Splits the bytes from the serial port into lines that end with LF or CR LF, in bounded memory.

After noise, the next LF ends the damaged line. Empty lines are dropped: the daemon starts every
session with a bare line end, and a board that echoes may send it back.
"""

from __future__ import annotations

MAX_LINE_BYTES = 128  # a reply has about 62, a status line with all fields about 100


class LineReader:
    def __init__(self) -> None:
        self._held = b""
        self._discarding = False
        self.too_long = 0

    def clear(self) -> None:
        """Forget an incomplete line, because the port has been reopened."""
        self._held = b""
        self._discarding = False

    def feed(self, data: bytes) -> list[tuple[bytes, int]]:
        """Return the lines that `data` completes, each with the number of bytes of `data` after it.

        From this number the caller computes when the line was complete on the wire.
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
