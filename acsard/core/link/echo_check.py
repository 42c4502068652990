"""Finds out whether the received lines only repeat the daemon's own, by asking.

TX and RX are joined, or the board reports its commands: equal bytes cannot tell, so they only raise
the question. The daemon sends `QUESTION` after the first line of a session, and when the lines of
half a second were lines that it had sent. An echo returns it, and a board answers with its name or
not at all. At rest every board repeats the line of zeros, so a link that is up is asked only if the
repeated speeds changed, or once when the lines of a steady drive begin to be repeated.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from acsard.core.values import NS_PER_S, Ns

QUESTION = b"?"  # it moves nothing

ANSWER_NS = NS_PER_S // 2  # a later `QUESTION` or name has another cause

REPEATED_NS = NS_PER_S // 50  # a name so soon after another one: no board boots in between

COMPARED_LINES = 8  # newest written lines: at 100 Hz, an echo within 70 ms is noticed

WINDOW_NS = NS_PER_S // 2

# Of the written lines that return: an echo beside a board's replies, of which some get lost.
RETURNED_FRACTION = 0.9

# In a row, in which a board without encoders repeats the commands: two may lie in a steady ramp of
# an ideal motor.
SET_POINT_WINDOWS = 3

_SPEEDS = 31  # bytes of a line without its checksum

_NO_SPEED = b"abcdpn0.,"  # of these bytes is the line of zeros


class EchoCheck:
    def __init__(self, encoders: bool) -> None:
        self._encoders = encoders  # `feedback.encoders`
        self.forget()

    def forget(self) -> None:
        """Forget everything, because the port was opened."""
        self.trouble: Literal["", "echo", "set_points"] = ""  # until the next opening
        self._asked_ns: Ns | None = None
        self._named_ns: Ns | None = None  # a board has last sent its name since the question
        self._written: deque[bytes] = deque(maxlen=COMPARED_LINES)
        self._speeds = b""  # of the last repeated line
        self._windows = 0  # in a row, of repeated lines with other speeds
        self._steady = False  # the last window had repeated lines of a moving robot
        self._begin(0)
        self.restart()

    def restart(self) -> None:
        """Ask again after the next line, because a new session begins."""
        self.due = self.asked = False  # in this session

    def _begin(self, now_ns: Ns) -> None:
        self.since_ns = now_ns  # begin of the window
        self._written_lines = self._lines = self._repeated = self._changes = 0

    def asks(self, at_ns: Ns) -> None:
        """Record that `QUESTION` was written."""
        self._asked_ns, self.due, self.asked, self._named_ns = at_ns, False, True, None

    def written(self, line: bytes) -> None:
        self._written.append(line.removesuffix(b"\r\n"))
        self._written_lines += 1

    def received(self, line: bytes) -> None:
        if not self.asked:
            self.due = True  # not before: a board that boots would not get it
        self._lines += 1
        if line in self._written:
            self._repeated += 1
            speeds, self._speeds = self._speeds, line[:_SPEEDS]
            self._changes += bool(speeds) and speeds != self._speeds

    def returned(self, at_ns: Ns) -> None:
        """Record that `QUESTION` was received."""
        if not self.trouble and self._answers(at_ns):
            self.trouble = "echo"

    def named(self, at_ns: Ns) -> bool:
        """Return whether a board's name, received now, answers the question.

        A hub or a repeater may send the answer twice.
        """
        named_ns, self._named_ns = self._named_ns, at_ns
        if named_ns is not None:
            return at_ns - named_ns <= REPEATED_NS
        return self._answers(at_ns)

    def _answers(self, at_ns: Ns) -> bool:
        return self._asked_ns is not None and at_ns - self._asked_ns <= ANSWER_NS

    def end_window(self, now_ns: Ns, moving: bool) -> None:
        """Ask, or find a board without encoders, `WINDOW_NS` or more after the window began.

        If `moving`, repeated zeros are no reason, and an equal speed is one only at first: a motor
        may be that steady.
        """
        least, changes = min(self._lines, RETURNED_FRACTION * self._written_lines), self._changes
        suspect = 0 < least <= self._repeated
        self._begin(now_ns)
        known, self._steady = self._steady, suspect and bool(self._speeds.strip(_NO_SPEED))
        if not suspect:
            self._windows = 0
            return
        self._windows += changes > 0
        if self.trouble or (moving and not changes and (known or not self._steady)):
            return
        if self._windows < SET_POINT_WINDOWS or self._asked_ns is None:
            self.due = True
        elif self._encoders and not self._answers(now_ns):
            self.trouble = "set_points"
