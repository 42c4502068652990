"""Whether the board has started anew in the middle of the check, by what it says.

Every figure of a step in which it did is wrong, and blames something else: cable, motor, watchdog.
"""

from __future__ import annotations

import re

from acsard.checkup import manual
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.limits import GLANCE_S
from acsard.checkup.motion import ZERO, Reply
from acsard.config.settings import McuConfig
from acsard.mcu.frames import Motors
from acsard.mcu.session import IDENTITY

ASKED_S = 1.0
"""So long after the question an identification is its answer."""

UNANSWERED = 5
"""Lines in a row without an answer, before a text is more than a debug print."""

AHEAD_S = 2.0
"""The board's clock may run on by so much more than ours between two replies: lines that were held
up on the way."""

CLOCK = 65536
"""ms after which the board's clock begins again."""

_WORD = re.compile(rb"[a-z]{3}|[G-Z]{3}")
"""In no reply, whole or damaged."""


class Restarts:
    """Follows one opening of the line; times are s."""

    def __init__(self) -> None:
        self.watched = True
        """Someone wants to know."""
        self._asked_s = self._turned_s = float("-inf")
        self._turned: Motors = ZERO
        """The last speeds that were no zeros."""
        self._unanswered = 0
        self._replied_s: float | None = None
        """None until it answers: what it says when it boots at the opening is no news."""
        self._clock: tuple[int, float] | None = None
        """Of the last reply that told it, ms, and when that came."""

    def asked(self, at_s: float) -> None:
        """It is asked who it is."""
        self._asked_s = at_s

    def sent(self, motors: Motors, at_s: float) -> None:
        """A line that says these speeds went out."""
        self._unanswered += 1
        if any(motors):
            self._turned, self._turned_s = motors, at_s

    def look(self, line: bytes, at_s: float, reply: Reply | None) -> str:
        """What of a line that came, a reply or none, shows a new start; "" for nothing."""
        sign = ""
        if reply is not None:
            sign = self._clock_sign(reply)
        elif self._replied_s is not None:
            sign = self._line_sign(line, at_s)
        if reply is not None and not sign:
            self._replied_s, self._unanswered = at_s, 0
        return sign if self.watched else ""

    def finding(self, mcu: McuConfig, sign: str) -> Finding:
        """What ends the check, with what turned when it was heard last."""
        heard_s = float("inf") if self._replied_s is None else self._replied_s
        turned = [m for m in range(4) if self._turned[m]]
        when = "everything stood"
        if self._turned_s > heard_s - GLANCE_S:
            when = f"{motor_names(mcu, turned, ', ')} turned"
        return manual.find("restarts: seen", when=when, sign=sign)

    def _line_sign(self, line: bytes, at_s: float) -> str:
        if line.startswith(IDENTITY) and at_s - self._asked_s > ASKED_S:
            why = re.search(rb" (reset=[a-z]{1,20})", line)  # our firmware tells
            return "it named itself, unasked" + (f" ({why[1].decode()})" if why else "")
        boots = self._unanswered >= UNANSWERED and _WORD.search(line)
        return "it was silent, then printed a text" if boots else ""

    def _clock_sign(self, reply: Reply) -> str:
        before, reading = self._clock, reply.reading
        if reading is None:
            return ""
        self._clock = reading.mcu_ms, reply.at_s
        if before is None:
            return ""
        most_ms = 1000 * (reply.at_s - before[1] + AHEAD_S)
        # Beyond half a minute without a reply it may have come round.
        if most_ms < CLOCK / 2 and (reading.mcu_ms - before[0]) % CLOCK > most_ms:
            return "its clock and its counts began again"
        return ""
