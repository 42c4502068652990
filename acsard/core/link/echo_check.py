"""Finds out whether the received lines only repeat the daemon's own, by asking.

TX and RX are joined, or the board reports its commands: equal bytes cannot tell, so they only raise
the question. The daemon sends `QUESTION` after the first line of a session, and when the lines of
half a second were lines that it had sent. An echo returns it, and a board answers with its name or
not at all. At rest every board repeats the line of zeros, so a link that is up is asked only if the
repeated speeds changed, or once when the lines of a steady drive begin to be repeated.

The motors of a servo drive can repeat each line of a ramp: their lag is that of a line. No motor
repeats the first line of a ramp, so a board that does so, time after time, has no encoders.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, STILL, Ns, WheelSpeeds

QUESTION = b"?"  # it moves nothing

ANSWER_NS = NS_PER_S // 2  # a later `QUESTION` or name has another cause

REPEATED_NS = NS_PER_S // 50  # a name so soon after another one: no board boots in between

WINDOW_NS = NS_PER_S // 2

# Of the written lines that return: an echo beside a board's replies, of which some get lost.
RETURNED_FRACTION = 0.9

HUNDREDTH = 0.005 + 1e-9  # rad/s; a speed this close to another one may be written like it

# First lines of ramps that were repeated, with no other reply in between. A motor repeats one by
# chance: in 300 s of driving on bad links, 119 of 300 ideal robots did once, 14 twice, none thrice.
RAMPS = 4

# In a steeper ramp, a motor whose lag is 2.5 ms misses the first line by a hundredth.
STEEP, STEEP_LINE = 4.0, 0.04  # rad/s2, and rad/s from one line to the next

_SPEED = re.compile(rb"[1-9]")  # in the part of a line before its checksum


class EchoCheck(Struct):
    """What was received since the port was opened, compared with the lines that were written."""

    trouble: Literal["", "echo", "set_points"] = ""  # until the next opening
    due: bool = False  # the question
    asked: bool = False  # in this session
    asked_ns: Ns | None = None
    named_ns: Ns | None = None  # a board has last sent its name since the question
    speeds: bytes = b""  # of the last repeated line
    ramps: int = 0  # up to `RAMPS`
    asked_of_ramps: bool = False  # the question was sent since the first of them
    reply: WheelSpeeds = STILL  # the last one
    steady: bool = False  # the last window had repeated lines of a moving robot
    # The window: its begin, the number of lines that were written before it, and the lines in it.
    since_ns: Ns = 0
    written: int = 0
    lines: int = 0  # received
    repeated: int = 0
    changes: int = 0  # of their speeds

    def restart(self) -> None:
        """Ask again after the next line, because a new session begins."""
        self.due = self.asked = False

    def _begin(self, now_ns: Ns, written: int) -> None:
        self.since_ns, self.written = now_ns, written
        self.lines = self.repeated = self.changes = 0

    def asks(self, at_ns: Ns) -> None:
        """Record that `QUESTION` was written."""
        self.asked_ns, self.due, self.asked, self.named_ns = at_ns, False, True, None
        self.asked_of_ramps = self.ramps > 0

    def received(self, line: bytes, written: list[bytes]) -> None:
        """Compare a received line with the newest `written` ones."""
        if not self.asked:
            self.due = True  # not before: a board that boots would not get it
        self.lines += 1
        if line + b"\r\n" in written:
            self.repeated += 1
            speeds, self.speeds = self.speeds, line.partition(b"#")[0]
            self.changes += bool(speeds) and speeds != self.speeds

    def measured(self, reply: WheelSpeeds, written: list[WheelSpeeds], period_s: float) -> None:
        """Compare a good reply with the newest `written` speeds, which are a period apart."""
        before, self.reply = self.reply, reply
        if reply == before:
            return
        speed = reply.front_right
        same = [n for n, line in enumerate(written) if abs(line.front_right - speed) <= HUNDREDTH]
        while same and not _repeats(reply, written[same[-1]]):
            del same[-1]
        if not same:
            self.ramps, self.asked_of_ramps = 0, False
        elif (n := same[-1]) >= 2:
            steep = max(STEEP_LINE, STEEP * period_s)
            steps = zip(*[line.as_tuple() for line in written[n - 2 : n + 1]], strict=True)
            if any(min(abs(c - b), abs(c - 2.0 * b + a)) > steep for a, b, c in steps):
                self.ramps = min(self.ramps + 1, RAMPS)

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
        changes, suspect = self.changes, 0 < least <= self.repeated
        self._begin(now_ns, written)
        known, self.steady = self.steady, suspect and _SPEED.search(self.speeds) is not None
        if self.trouble:
            return
        if self.ramps == RAMPS and self.asked_of_ramps:
            if encoders and not self._answers(now_ns):
                self.trouble = "set_points"
        elif self.ramps == RAMPS or (
            suspect and (not moving or changes > 0 or (self.steady and not known))
        ):
            self.due = True


def _repeats(reply: WheelSpeeds, line: WheelSpeeds) -> bool:
    pairs = zip(reply.as_tuple(), line.as_tuple(), strict=True)
    return all(abs(a - b) <= HUNDREDTH for a, b in pairs)
