"""Detects restarts of the board during the check, from the lines that the board sends.

A restart falsifies the measurements of the present step, so that the cable, a motor or the watchdog
seems to be at fault. The step is therefore repeated (`procedure.py`). At the end of the check, a
finding gives the probable cause of the restarts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import outcomes
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motion import BOOT_S, GLANCE_S, ZERO, Reply
from acsard.core.config.settings import McuConfig
from acsard.core.link.codec import Motors
from acsard.core.link.session import IDENTITY
from acsard.core.values import AcsardError

ASKED_S = 1.0
"""Longest time from a request for the identification to the board's answer, s. If an identification
arrives later, the board sent it without a request."""

UNANSWERED = 5
"""A text from the board shows a restart if at least this many successive lines had no reply. With
fewer such lines, the text may be a debug print of the firmware."""

AHEAD_S = 2.0
"""Tolerance for the board's clock, s. Between two replies, this clock may advance by up to this
much more than this computer's clock, for example because a line was delayed. A larger advance shows
a restart, because the jump back to 0 looks like a large advance modulo `CLOCK`."""

CLOCK = 65536
"""Time after which the board's clock starts again at 0, ms."""

SILENT_S = 0.25
"""Shortest time without a sent line after which a watchdog may restart the whole board, s."""

CAUSES = {"power": "supply", "brown-out": "supply", "watchdog": "watchdog", "pin": "pin"}
"""Maps each cause of a restart that the reference firmware reports to an outcome of the check."""

_WORD = re.compile(rb"[a-z]{3}|[G-Z]{3}")
"""Pattern that occurs in printed texts, but in no reply, not even in a damaged one."""

_CAUSE = re.compile(rb" reset=([a-z-]{1,20})")


class Restart(Struct, frozen=True):
    sign: str
    """The observation that revealed the restart, in words."""
    turned: Motors = ZERO
    """Speeds that were commanded just before the restart, rad/s; zeros if the motors stood."""
    silent_s: float = 0.0
    """Longest time without a line to the board, between its last reply and the restart, s."""
    cause: str = ""
    """Cause of the restart as the board reports it, or "" if the board reports no cause."""


class RestartedError(AcsardError):
    """The board restarted, so the present measurement is worthless."""

    def __init__(self, restart: Restart) -> None:
        super().__init__(restart.sign)
        self.restart = restart


class Restarts:
    """Detector of restarts since the port was opened. All times are monotonic, in s."""

    def __init__(self) -> None:
        self.watched = True
        """Whether `look()` reports restarts."""
        self._asked_s = self._turned_s = float("-inf")
        self._turned: Motors = ZERO
        """The last commanded speeds that were not all zero, rad/s."""
        self._sent_s: float | None = None
        self._silent_s = 0.0
        """Longest time between two lines to the board since the last reply, s."""
        self._unanswered = 0
        self._replied_s: float | None = None
        """Time of the last reply, s, or None before the first reply. Before the first reply, a text
        from the board does not show a restart: the opening of the port resets many boards, and
        they print texts when they boot."""
        self._clock: tuple[int, float] | None = None
        """Pair: the board's clock, ms, in the last reply that contained it, and the time of that
        reply, s."""

    def asked(self, at_s: float) -> None:
        """Record that the check requested the identification at the monotonic time `at_s`, s."""
        self._asked_s = at_s

    def sent(self, motors: Motors, at_s: float) -> None:
        """Record that the check sent these speeds, rad/s, at the monotonic time `at_s`, s."""
        self._unanswered += 1
        self._silent_s, self._sent_s = self._silence_s(at_s), at_s
        if any(motors):
            self._turned, self._turned_s = motors, at_s

    def look(self, line: bytes, at_s: float, reply: Reply | None) -> Restart | None:
        """Return the restart that a received line reveals, or None.

        `at_s` is the monotonic time of its arrival, s. `reply` is the decoded line, or None if the
        line is not a valid reply.
        """
        sign = ""
        if reply is not None:
            sign = self._clock_sign(reply)
        elif self._replied_s is not None:
            sign = self._line_sign(line, at_s)
        if reply is not None and not sign:
            self._replied_s, self._unanswered, self._silent_s = at_s, 0, 0.0
        if not (sign and self.watched):
            return None
        heard_s = float("inf") if self._replied_s is None else self._replied_s
        turned = self._turned if self._turned_s > heard_s - GLANCE_S else ZERO
        return Restart(sign, turned, self._silence_s(at_s), cause([line]))

    def _silence_s(self, at_s: float) -> float:
        now_s = 0.0 if self._sent_s is None else at_s - self._sent_s
        return max(self._silent_s, now_s)

    def _line_sign(self, line: bytes, at_s: float) -> str:
        if line.startswith(IDENTITY) and at_s - self._asked_s > ASKED_S:
            return "the board sent its name without a request"
        boots = self._unanswered >= UNANSWERED and _WORD.search(line)
        return "the board was silent, then sent a text instead of replies" if boots else ""

    def _clock_sign(self, reply: Reply) -> str:
        before, reading = self._clock, reply.reading
        if reading is None:
            return ""
        self._clock = reading.mcu_ms, reply.at_s
        if before is None:
            return ""
        most_ms = 1000 * (reply.at_s - before[1] + AHEAD_S)
        # After half a minute without a reply, an overflow may have set the clock back to 0.
        if most_ms < CLOCK / 2 and (reading.mcu_ms - before[0]) % CLOCK > most_ms:
            return "the board's clock and encoder counts started again from 0"
        return ""


def cause(lines: Sequence[bytes]) -> str:
    """Return the cause of a restart that these lines report, or "" if they report none."""
    said = [match[1].decode() for line in lines if (match := _CAUSE.search(line))]
    return said[-1] if said else ""


def finding(mcu: McuConfig, restarts: Sequence[Restart], back: bool = True) -> Finding:
    """Return the finding about `restarts`. `back` says whether the board answers again."""
    each = Counter(_told(mcu, one) for one in restarts)
    seen: dict[str, object] = {
        "times": f"restarted{_times(len(restarts))}",
        "told": "; ".join(f"while {when}{_times(n)}: {sign}" for (when, sign), n in each.items()),
        "silent": min(one.silent_s for one in restarts),
        "patience": BOOT_S,
    }
    return outcomes.find(f"restarts: {_outcome(restarts) if back else 'gone'}", None, **seen)


def _outcome(restarts: Sequence[Restart]) -> str:
    said = {CAUSES[one.cause] for one in restarts if one.cause in CAUSES}
    if len(said) == 1 and not (said == {"watchdog"} and _silent(restarts)):
        return said.pop()
    if len(restarts) == 1:
        return "seen"
    if _silent(restarts):
        return "silence"
    return "motors" if all(any(one.turned) for one in restarts) else "seen"


def _silent(restarts: Sequence[Restart]) -> bool:
    """Return whether there are several restarts, each after `SILENT_S` without a sent line."""
    return len(restarts) > 1 and all(one.silent_s >= SILENT_S for one in restarts)


def _told(mcu: McuConfig, restart: Restart) -> tuple[str, str]:
    turned = [motor for motor in range(4) if restart.turned[motor]]
    when = f"{motor_names(mcu, turned, ', ')} turned" if turned else "no motor turned"
    return when, restart.sign + (f" (reset={restart.cause})" if restart.cause else "")


def _times(count: int) -> str:
    return "" if count == 1 else ", twice" if count == 2 else f", {count} times"
