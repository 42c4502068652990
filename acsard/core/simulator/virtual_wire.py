"""A serial connection to the simulated board in virtual time, so that waiting takes no real time.

`acsard mcu check` can use it instead of a port. Different baud rates garble the bytes in both
directions.
"""

from __future__ import annotations

from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import Ns

Piece = tuple[int, bytes]


class VirtualWire:
    def __init__(self, mcu: FakeMcu, now_ns: Ns = 0) -> None:
        self.mcu = mcu
        self.is_open = False
        self._baud_rate = 0
        self._now_ns = now_ns

    def open(self, baud_rate: int) -> None:
        """Open the connection, or change its baud rate."""
        self.is_open, self._baud_rate = True, baud_rate

    def close(self) -> None:
        self.is_open = False

    def now_ns(self) -> Ns:
        return self._now_ns

    def late_ns(self) -> Ns:
        """Return 0: the simulated board never waits for a processor."""
        return 0

    def send(self, data: bytes) -> None:
        assert self.is_open, "the connection is closed"
        self.mcu.receive(self._now_ns, garbled(data, self._baud_rate, self.mcu.switches.baud_rate))

    def listen(self, until_ns: Ns) -> list[Piece]:
        """Advance the virtual time, and return pieces of bytes with the time of their arrival."""
        pieces = []
        while (due_ns := self.mcu.next_ns()) is not None and due_ns <= until_ns:
            due_ns = max(due_ns, self._now_ns)
            data = self.mcu.advance(due_ns)
            if data:
                pieces.append((due_ns, garbled(data, self.mcu.switches.baud_rate, self._baud_rate)))
        self._now_ns = max(self._now_ns, until_ns)
        self.mcu.advance(self._now_ns)
        return pieces
