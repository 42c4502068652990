"""Splits the bytes from the serial port into lines that end with LF, in bounded memory.

A CR before or after the LF belongs to the line end.

After noise, the next LF ends the damaged line. Empty lines are dropped: the daemon starts every
session with a bare line end, and a board that echoes may send it back.
"""

from __future__ import annotations

from msgspec import Struct

MAX_LINE_BYTES = 128  # a reply has about 62, a status line with all fields about 100


class LineReader(Struct):
    held: bytes = b""  # incomplete line
    discarding: bool = False
    too_long: int = 0

    def clear(self) -> None:
        """Forget an incomplete line, because the port has been reopened."""
        self.held = b""
        self.discarding = False

    def feed(self, data: bytes) -> list[tuple[bytes, int]]:
        """Return the lines that `data` completes, each with the number of bytes of `data` after it.

        From this number the caller computes when the line was complete on the wire.
        """
        lines = []
        *ends, rest = data.split(b"\n")
        following = len(data)
        for piece in ends:
            following -= len(piece) + 1
            line, self.held = self.held + piece, b""
            if self.discarding:
                self.discarding = False
            elif len(line) >= MAX_LINE_BYTES:
                self.too_long += 1
            elif line := line.strip(b"\r"):
                lines.append((line, following))
        if rest and not self.discarding:
            self.held += rest
            if len(self.held) >= MAX_LINE_BYTES:
                self.too_long += 1
                self.held = b""
                self.discarding = True
        return lines
