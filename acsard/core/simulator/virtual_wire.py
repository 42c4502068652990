"""A serial connection to the simulated board in virtual time, so that waiting takes no real time.

`acsard mcu check` can use this connection instead of a serial port (`checkup.board.Wire`). If the
host and the board use different baud rates, the bytes in both directions are garbled.
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
        """Open the connection at `baud_rate`, or change the baud rate of the open connection."""
        self.is_open, self._baud_rate = True, baud_rate

    def close(self) -> None:
        """Close the connection. After that, no bytes can be sent."""
        self.is_open = False

    def now_ns(self) -> int:
        """Return the virtual time, ns."""
        return self._now_ns

    def late_ns(self) -> int:
        """Return for how long the simulated board waited for a processor, ns.

        In virtual time, the board never waits, so the result is always 0.
        """
        return 0

    def send(self, data: bytes) -> None:
        assert self.is_open, "the connection is closed"
        self.mcu.receive(self._now_ns, garbled(data, self._baud_rate, self.mcu.baud_rate))

    def listen(self, until_ns: int) -> list[Piece]:
        """Advance the virtual time to `until_ns`, and return the bytes that the host receives.

        The result is a list of pairs: the virtual time at which some bytes arrived, ns, and these
        bytes.
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
