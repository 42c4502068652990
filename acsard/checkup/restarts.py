"""Whether the board has started anew in the middle of the check, by what it says.

Every figure of a step in which it did is wrong, and blames something else: cable, motor, watchdog.
So the step is tried again (`procedure.py`), and what started the board anew is told at the end.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import manual
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.limits import BOOT_S, GLANCE_S
from acsard.checkup.motion import ZERO, Reply
from acsard.config.settings import McuConfig
from acsard.mcu.codec import Motors
from acsard.mcu.session import IDENTITY
from acsard.values import AcsardError

ASKED_S = 1.0
"""So long after the question an identification is its answer."""

UNANSWERED = 5
"""Lines in a row without an answer, before a text is more than a debug print."""

AHEAD_S = 2.0
"""The board's clock may run on by so much more than ours between two replies: lines that were held
up on the way."""

CLOCK = 65536
"""ms after which the board's clock begins again."""

SILENT_S = 0.25
"""A silence of ours that a watchdog may have taken for the host's end."""

CAUSES = {"power": "supply", "brown-out": "supply", "watchdog": "watchdog", "pin": "pin"}
"""What our firmware says that it booted for -> the outcome; "unknown" is none."""

_WORD = re.compile(rb"[a-z]{3}|[G-Z]{3}")
"""In no reply, whole or damaged."""

_CAUSE = re.compile(rb" reset=([a-z-]{1,20})")


class Restart(Struct, frozen=True):
    """One new start of the board."""

    sign: str
    """By what it was seen."""
    turned: Motors = ZERO
    """What the motors were told when it was heard last."""
    silent_s: float = 0.0
    """For how long at the most this host had sent nothing since then."""
    cause: str = ""
    """What the board says that it booted for, "" where it says nothing."""


class RestartedError(AcsardError):
    """The board has started anew: what was being measured is worth nothing."""

    def __init__(self, restart: Restart) -> None:
        super().__init__(restart.sign)
        self.restart = restart


class Restarts:
    """Follows one opening of the line; times are s."""

    def __init__(self) -> None:
        self.watched = True
        """Someone wants to know."""
        self._asked_s = self._turned_s = float("-inf")
        self._turned: Motors = ZERO
        """The last speeds that were no zeros."""
        self._sent_s: float | None = None
        self._silent_s = 0.0
        """The longest time between two lines of ours since it answered last."""
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
        self._silent_s, self._sent_s = self._silence_s(at_s), at_s
        if any(motors):
            self._turned, self._turned_s = motors, at_s

    def look(self, line: bytes, at_s: float, reply: Reply | None) -> Restart | None:
        """The new start that a line that came, a reply or none, shows; None where it shows none."""
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
            return "it named itself, unasked"
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


def cause(lines: Sequence[bytes]) -> str:
    """What the board says in these that it booted for, "" where it does not; our firmware does."""
    said = [match[1].decode() for line in lines if (match := _CAUSE.search(line))]
    return said[-1] if said else ""


def finding(mcu: McuConfig, restarts: Sequence[Restart], back: bool = True) -> Finding:
    """What started it anew, as far as these tell, which are not none; it is `back`, or not yet."""
    each = Counter(_told(mcu, one) for one in restarts)
    seen: dict[str, object] = {
        "times": f"started anew{_times(len(restarts))}",
        "told": "; ".join(f"while {when}{_times(n)}: {sign}" for (when, sign), n in each.items()),
        "silent": min(one.silent_s for one in restarts),
        "patience": BOOT_S,
    }
    return manual.find(f"restarts: {_outcome(restarts) if back else 'gone'}", None, **seen)


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
    """Each after a silence of ours: it takes more than one to tell."""
    return len(restarts) > 1 and all(one.silent_s >= SILENT_S for one in restarts)


def _told(mcu: McuConfig, restart: Restart) -> tuple[str, str]:
    """When it was, and by what it was seen."""
    turned = [motor for motor in range(4) if restart.turned[motor]]
    when = f"{motor_names(mcu, turned, ', ')} turned" if turned else "everything stood"
    return when, restart.sign + (f" (reset={restart.cause})" if restart.cause else "")


def _times(count: int) -> str:
    return "" if count == 1 else ", twice" if count == 2 else f", {count} times"
