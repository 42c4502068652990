"""A serial connection to the simulated board in virtual time, in which waiting takes no real time.

`acsard mcu check` can use this connection in place of a serial port (`checkup.board.Wire`). If the
baud rates of host and board differ, the bytes of both directions arrive garbled.
"""

from __future__ import annotations

from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import FakeMcu

Piece = tuple[int, bytes]


class VirtualWire:
    """The host's end of a serial connection to the simulated board, in virtual time."""

    def __init__(self, mcu: FakeMcu, now_ns: int = 0) -> None:
        self.mcu = mcu
        self.is_open = False
        self._baud_rate = 0
        self._now_ns = now_ns

    def open(self, baud_rate: int) -> None:
        """Open the connection, or change the baud rate of the open connection."""
        self.is_open, self._baud_rate = True, baud_rate

    def close(self) -> None:
        """Close the connection. No bytes can be sent after that."""
        self.is_open = False

    def now_ns(self) -> int:
        """Return the virtual time, ns."""
        return self._now_ns

    def late_ns(self) -> int:
        """Return 0, because in virtual time a busy processor delays nothing."""
        return 0

    def send(self, data: bytes) -> None:
        assert self.is_open, "the connection is closed"
        self.mcu.receive(self._now_ns, garbled(data, self._baud_rate, self.mcu.baud_rate))

    def listen(self, until_ns: int) -> list[Piece]:
        """Advance the virtual time to `until_ns`, and return the bytes that the host receives.

        The bytes come in pieces. Each piece is a pair of the virtual time of its arrival, ns, and
        its bytes.
        """
        pieces = []
        while (due_ns := self.mcu.next_ns()) is not None and due_ns <= until_ns:
            due_ns = max(due_ns, self._now_ns)
            data = self.mcu.advance(due_ns)
            if data:
                pieces.append((due_ns, garbled(data, self.mcu.baud_rate, self._baud_rate)))
        self._now_ns = max(self._now_ns, until_ns)
        self.mcu.advance(self._now_ns)
        return pieces
