"""A serial line to the fake MCU in virtual time: no clock runs, waiting costs nothing.

The side of `acsard mcu check` that is asked to listen (`checkup.outside.Wire`); a wrong baud rate
garbles both ways.
"""

from __future__ import annotations

from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.garble import garbled

Piece = tuple[int, bytes]


class VirtualWire:
    """The host's end of the line."""

    def __init__(self, mcu: FakeMcu, now_ns: int = 0) -> None:
        self.mcu = mcu
        self.is_open = False
        self._baud_rate = 0
        self._now_ns = now_ns

    def open(self, baud_rate: int) -> None:
        """Open the line, or go on at another rate."""
        self.is_open, self._baud_rate = True, baud_rate

    def close(self) -> None:
        """Nothing more goes out."""
        self.is_open = False

    def now_ns(self) -> int:
        """The time here."""
        return self._now_ns

    def late_ns(self) -> int:
        """Nothing waits for a processor."""
        return 0

    def send(self, data: bytes) -> None:
        """Put bytes on the line now."""
        assert self.is_open, "a closed line carries nothing"
        self.mcu.receive(self._now_ns, garbled(data, self._baud_rate, self.mcu.baud_rate))

    def listen(self, until_ns: int) -> list[Piece]:
        """Let time pass; what came, in pieces, each with its time."""
        pieces = []
        while (due_ns := self.mcu.next_ns()) is not None and due_ns <= until_ns:
            due_ns = max(due_ns, self._now_ns)
            data = self.mcu.advance(due_ns)
            if data:
                pieces.append((due_ns, garbled(data, self.mcu.baud_rate, self._baud_rate)))
        self._now_ns = max(self._now_ns, until_ns)
        self.mcu.advance(self._now_ns)
        return pieces
