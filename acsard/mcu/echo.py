"""Recognizes plain lines that only come back: TX and RX are joined, or the far end echoes.

A plain reply has the same form as a command, so an echo looks like a board that reports exactly the
speeds it was sent. A real board cannot do that while the speeds change: its encoders report the
time before the change, and its wheels lag. So an echo is a run of `REPORTS` reports, each equal
byte for byte to the line just sent, through changes of speed that add up to `CHANGE`. At rest every
board looks like an echo, and nothing is decided.

An echo that comes back later than the line after it leaves is not recognized: at 100 Hz, an adapter
that holds bytes back for 16 ms hides it. Comparing with older lines would take an ideal simulated
board for an echo.

The checked link needs none of this: no reply carries the letters of a question.
"""

from __future__ import annotations

from collections import deque

from acsard.config.wire_time import wire_ns
from acsard.values import WheelSpeeds

REPORTS = 20
"""Equal reports in a row: 0.2 s at 100 Hz."""

CHANGE = 2.0
"""rad/s; sum of the changes among them, of the wheel that changes most. A small one alone may be a
coincidence of coarse encoders."""

RECENT = 4
"""Lines that may be on their way at the same time."""


class EchoDetector:
    """Compares each report with the line that could just have come back."""

    def __init__(self, baud_rate: int) -> None:
        self._baud_rate = baud_rate
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=RECENT)
        self._before: WheelSpeeds | None = None
        """Speeds of the report before, if it was equal to its line."""
        self._equal, self._change = 0, 0.0

    def forget(self) -> None:
        """Start over: the port has been opened."""
        self._sent.clear()
        self._before, self._equal, self._change = None, 0, 0.0

    def left(self, line: bytes, at_ns: int) -> None:
        """Note that this line left, with its end, at this monotonic time."""
        back_ns = at_ns + wire_ns(len(line), self._baud_rate)
        self._sent.append((back_ns, line.removesuffix(b"\r\n")))

    def report(self, line: bytes, speeds: WheelSpeeds, at_ns: int) -> bool:
        """Take a report without its end, and the speeds in it; return whether it is an echo."""
        if not self._just_sent(line, at_ns):
            self._before, self._equal, self._change = None, 0, 0.0
            return False
        before, self._before = self._before, speeds
        self._equal += 1
        if before is not None and before != speeds:
            pairs = zip(before.as_tuple(), speeds.as_tuple(), strict=True)
            self._change += max([abs(now - then) for then, now in pairs])
        return self._equal >= REPORTS and self._change >= CHANGE

    def _just_sent(self, line: bytes, at_ns: int) -> bool:
        """Return whether it is the newest line that can have come back over the wire.

        A newer one counts too: a terminal that echoes does not wait for the wire.
        """
        for back_ns, sent in reversed(self._sent):
            if line == sent:
                return True
            if back_ns <= at_ns:
                return False
        return False
