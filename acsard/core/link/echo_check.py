"""Finds out whether the received lines only repeat the daemon's own, by asking.

TX and RX are joined, or the board reports its commands: equal bytes cannot tell, so they only raise
the question. The daemon sends `QUESTION` after the first line of a session, and when the lines of
half a second were lines that it had sent. An echo returns it, and a board answers with its name or
not at all. At rest every board repeats the line of zeros, so a link that is up is asked only if the
repeated speeds changed, or once when the lines of a steady drive begin to be repeated. A board has
no encoders if it repeats the begins and ends of ramps, too: in a steady ramp, the lag of an ideal
motor is that of a line.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns

QUESTION = b"?"  # it moves nothing

ANSWER_NS = NS_PER_S // 2  # a later `QUESTION` or name has another cause

REPEATED_NS = NS_PER_S // 50  # a name so soon after another one: no board boots in between

WINDOW_NS = NS_PER_S // 2

# Of the written lines that return: an echo beside a board's replies, of which some get lost.
RETURNED_FRACTION = 0.9

# In a row, in which a board without encoders repeats the begin or the end of a ramp.
SET_POINT_WINDOWS = 3

_SPEED = re.compile(rb"[1-9]")  # in the part of a line before its checksum


class EchoCheck(Struct):
    """What was received since the port was opened, compared with the lines that were written."""

    trouble: Literal["", "echo", "set_points"] = ""  # until the next opening
    due: bool = False  # the question
    asked: bool = False  # in this session
    asked_ns: Ns | None = None
    named_ns: Ns | None = None  # a board has last sent its name since the question
    speeds: bytes = b""  # of the last repeated line
    windows: int = 0  # in a row, of repeated lines with a turn
    steady: bool = False  # the last window had repeated lines of a moving robot
    # The window: its begin, the number of lines that were written before it, and the lines in it.
    since_ns: Ns = 0
    written: int = 0
    lines: int = 0  # received
    repeated: int = 0
    changes: int = 0  # of their speeds
    turns: int = 0  # from equal speeds to other ones, or back, in lines that follow each other
    last: Literal["", "equal", "other"] = ""  # the speed of the last line, if it was repeated

    def restart(self) -> None:
        """Ask again after the next line, because a new session begins."""
        self.due = self.asked = False

    def _begin(self, now_ns: Ns, written: int) -> None:
        self.since_ns, self.written = now_ns, written
        self.lines = self.repeated = self.changes = self.turns = 0

    def asks(self, at_ns: Ns) -> None:
        """Record that `QUESTION` was written."""
        self.asked_ns, self.due, self.asked, self.named_ns = at_ns, False, True, None

    def received(self, line: bytes, written: list[bytes]) -> None:
        """Compare a received line with the newest `written` ones."""
        if not self.asked:
            self.due = True  # not before: a board that boots would not get it
        self.lines += 1
        before, self.last = self.last, ""
        if line + b"\r\n" in written:
            self.repeated += 1
            speeds, self.speeds = self.speeds, line.partition(b"#")[0]
            changed = bool(speeds) and speeds != self.speeds
            self.changes += changed
            self.last = "other" if changed else "equal"
            self.turns += before not in ("", self.last)

    def returned(self, at_ns: Ns) -> None:
        """Record that `QUESTION` was received."""
        if not self.trouble and self._answers(at_ns):
            self.trouble = "echo"

    def named(self, at_ns: Ns) -> bool:
        """Return whether a board's name, received now, answers the question.

        A hub or a repeater may send the answer twice.
        """
        named_ns, self.named_ns = self.named_ns, at_ns
        if named_ns is not None:
            return at_ns - named_ns <= REPEATED_NS
        return self._answers(at_ns)

    def _answers(self, at_ns: Ns) -> bool:
        return self.asked_ns is not None and at_ns - self.asked_ns <= ANSWER_NS

    def end_window(self, now_ns: Ns, written: int, moving: bool, encoders: bool) -> None:
        """Ask, or find a board without encoders, `WINDOW_NS` or more after the window began.

        `written` lines left since the opening. If `moving`, repeated zeros are no reason, and an
        equal speed is one only at first: a motor may be that steady. `encoders` is
        `feedback.encoders`.
        """
        least = min(self.lines, RETURNED_FRACTION * (written - self.written))
        changes, turns = self.changes, self.turns
        suspect = 0 < least <= self.repeated
        self._begin(now_ns, written)
        known, self.steady = self.steady, suspect and _SPEED.search(self.speeds) is not None
        if not suspect:
            self.windows = 0
            return
        self.windows += turns > 0
        if self.trouble or (moving and not changes and (known or not self.steady)):
            return
        if self.windows < SET_POINT_WINDOWS or self.asked_ns is None:
            self.due = True
        elif encoders and not self._answers(now_ns):
            self.trouble = "set_points"
