"""Recognizes plain lines that only come back: TX and RX are joined, or the far end echoes.

A plain reply has the same form as a command, so an echo looks like a board that reports exactly the
speeds it was sent. An echo is a run of `REPORTS` reports, each equal byte for byte to a line that
was sent, always the same number of lines before. The changes of speed in the run add up to
`CHANGE`. At rest every board looks like an echo, and nothing is decided.

A board that measures is not taken for an echo, because its wheels lag behind the lines in another
way than by a whole number of lines. In simulated drives with accelerations of 0.1 to 100 m/s2 and
encoders of up to 1,000,000 counts a turn, equal reports in a row covered at most 0.04 rad/s of
changes if the motors lag by 2 ms or more. A board that reports its set points, or a simulator whose
wheels have no lag at all, looks exactly like an echo. The daemon then drives nothing until the port
is opened again, and says why.

The checked link needs none of this: no reply carries the letters of a question.
"""

from __future__ import annotations

from collections import deque

from acsard.core.values import WheelSpeeds

REPORTS = 20
"""Equal reports in a row: 0.2 s at 100 Hz."""

CHANGE = 2.0
"""rad/s; sum of the changes among them, of the wheel that changes most. A small one alone may be a
coincidence of coarse encoders."""

LINES = 8
"""Lines that a report is compared with: an echo that comes back within 70 ms at 100 Hz is found."""

_Run = tuple[int, float, WheelSpeeds]
"""The equal reports in a row, the sum of their changes, and the speeds of the last one."""


class EchoDetector:
    """Compares each report with the last `LINES` lines."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start over: the port has been opened."""
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=LINES)
        """The last lines, each with its number."""
        self._lines = self._reports = 0
        self._runs: dict[int, _Run] = {}
        """By the number of a report minus that of its line, which no delay of an echo changes."""

    def left(self, line: bytes) -> None:
        """Note that this line left, with its end."""
        self._lines += 1
        self._sent.append((self._lines, line.removesuffix(b"\r\n")))

    def report(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Take a report without its end, and the speeds in it; return whether it is an echo."""
        self._reports += 1
        runs: dict[int, _Run] = {}
        first, found = (0, 0.0, speeds), False
        for number, sent in self._sent:
            if line == sent:
                offset = self._reports - number
                equal, change, before = self._runs.get(offset, first)
                if before != speeds:
                    pairs = zip(before.as_tuple(), speeds.as_tuple(), strict=True)
                    change += max([abs(now - then) for then, now in pairs])
                runs[offset] = equal + 1, change, speeds
                found = found or (equal + 1 >= REPORTS and change >= CHANGE)
        self._runs = runs
        return found
