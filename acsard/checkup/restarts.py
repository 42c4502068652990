"""Detects restarts of the board during the check, from the lines that the board sends.

After a restart, the cable, a motor or the watchdog would seem to be at fault, so `procedure.py`
repeats the step. At the end a finding gives the probable cause.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import outcomes
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motion import BOOT_S, SHORT_MEASUREMENT_S, BoardReply
from acsard.core.config.settings import McuConfig
from acsard.core.link.board_status import IDENTITY
from acsard.core.link.codec import Motors
from acsard.core.values import AcsardError, Seconds

# A later identification was sent without a request, because the board booted.
ANSWER_TIMEOUT_S = 1.0

# After fewer lines without a reply, a text may be a debug print of the firmware.
RESTART_UNANSWERED_LINES = 5

# By which the board's clock may advance more than this computer's between two replies. A clock
# that restarts seems to advance by far more, modulo `CLOCK_RANGE_MS`.
CLOCK_TOLERANCE_S = 2.0

CLOCK_RANGE_MS = 65536  # time after which the board's clock overflows and continues at 0

# Shortest time without a line to the board that can make its watchdog restart the board.
MIN_SILENCE_S = 0.25

# From the causes of the reference firmware to outcomes, without "restarts: ".
CAUSES: dict[str, outcomes.Outcome] = {
    "power": "restarts: supply",
    "brown-out": "restarts: supply",
    "watchdog": "restarts: watchdog",
    "pin": "restarts: pin",
}

# Pattern of three letters in a row, by which a text is recognized. A reply does not contain them,
# even if it is damaged.
_WORD = re.compile(rb"[a-z]{3}|[G-Z]{3}")

# By which the check knows a text again that the firmware prints now and then.
KNOWN_BYTES = 12

_NUMBER = re.compile(rb"[0-9]+")

_CAUSE = re.compile(rb" reset=([a-z-]{1,20})")


class Restart(Struct, frozen=True):
    """One restart of the board."""

    sign: str  # the observation that shows the restart, in words
    # Speeds that were commanded shortly before the restart, rad/s; empty if no motor turned.
    turned: Motors = ()
    # Longest time without a line to the board, from the board's last reply to the restart.
    silent_s: Seconds = 0.0
    # Cause of the restart as the board reports it, or "" if the board does not report a cause.
    cause: str = ""


class RestartedError(AcsardError):
    """The board restarted, so the measurements of the present step are wrong."""

    def __init__(self, restart: Restart) -> None:
        super().__init__(restart.sign)
        self.restart = restart


class Restarts:
    """Detector of restarts of the board. All times are monotonic times, s."""

    def __init__(self) -> None:
        # Whether `check_line` reports restarts. If false, `check_line` always returns None.
        self.watched = True
        self._asked_s = self._turned_s = float("-inf")
        self._turned: Motors = ()  # the last commanded speeds, rad/s, that were not all zero
        self._sent_s: float | None = None
        self._silent_s = 0.0  # longest time between two sent lines since the board's last reply
        self._unanswered = 0
        self._texts: set[bytes] = set()  # beginnings of texts that came between replies
        # None before the first reply. Until then a text shows no restart: many boards boot when
        # opened.
        self._replied_s: Seconds | None = None
        # Pair from the last reply that contained the board's clock: this clock, ms, and the time of
        # that reply, s. None if no reply has contained the clock.
        self._clock: tuple[int, float] | None = None

    def record_request(self, at_s: float) -> None:
        """Record that the check requested the board's identification at the time `at_s`, s."""
        self._asked_s = at_s

    def record_speeds(self, motors: Motors, at_s: float) -> None:
        """Record that the check sent the speeds `motors`, rad/s, at the time `at_s`, s."""
        self._unanswered += 1
        self._silent_s, self._sent_s = self._silence_s(at_s), at_s
        if any(motors):
            self._turned, self._turned_s = motors, at_s

    def check_line(self, line: bytes, at_s: float, reply: BoardReply | None) -> Restart | None:
        """Process a line that arrived at `at_s`. Return a `Restart` if it shows one.

        `reply` is the decoded line, or None if it is not a valid reply.
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
        turned = self._turned if self._turned_s > heard_s - SHORT_MEASUREMENT_S else ()
        return Restart(sign, turned, self._silence_s(at_s), cause([line]))

    def _silence_s(self, at_s: float) -> float:
        now_s = 0.0 if self._sent_s is None else at_s - self._sent_s
        return max(self._silent_s, now_s)

    def _line_sign(self, line: bytes, at_s: float) -> str:
        if line.startswith(IDENTITY) and at_s - self._asked_s > ANSWER_TIMEOUT_S:
            return "the board sent its name without a request"
        if not _WORD.search(line):
            return ""
        text = _NUMBER.sub(b"0", line)[:KNOWN_BYTES]
        if self._unanswered < RESTART_UNANSWERED_LINES:
            self._texts.add(text)
        known = text in self._texts
        return "" if known else "the board was silent, then sent a text instead of replies"

    def _clock_sign(self, reply: BoardReply) -> str:
        before, reading = self._clock, reply.reading
        if reading is None:
            return ""
        self._clock = reading.mcu_ms, reply.at_s
        if before is None:
            return ""
        most_ms = 1000 * (reply.at_s - before[1] + CLOCK_TOLERANCE_S)
        # After half a minute without a reply, the difference modulo `CLOCK_RANGE_MS` proves
        # nothing, because the clock may have overflowed.
        if most_ms < CLOCK_RANGE_MS / 2 and (reading.mcu_ms - before[0]) % CLOCK_RANGE_MS > most_ms:
            return "the board's clock and encoder counts started again from 0"
        return ""


def cause(lines: Sequence[bytes]) -> str:
    """Return the cause of the last restart that the board reports in `lines`, or ""."""
    causes = [match[1].decode() for line in lines if (match := _CAUSE.search(line))]
    return causes[-1] if causes else ""


def finding(mcu: McuConfig, restarts: Sequence[Restart], back: bool = True) -> Finding:
    """Return the finding about one or more `restarts`; `back` says whether the board answered."""
    each = Counter(_restart_texts(mcu, restart) for restart in restarts)
    return outcomes.find(
        _outcome(restarts) if back else "restarts: gone",
        times=f"restarted, {_times(len(restarts))}".removesuffix(", "),
        events="; ".join(
            f"{_times(n)} while {when}: {sign}".lstrip() for (when, sign), n in each.items()
        ),
        silent=min(restart.silent_s for restart in restarts),
        patience=BOOT_S,
    )


def _outcome(restarts: Sequence[Restart]) -> outcomes.Outcome:
    causes = {CAUSES[restart.cause] for restart in restarts if restart.cause in CAUSES}
    if len(causes) == 1 and not (causes == {"restarts: watchdog"} and _silent(restarts)):
        return causes.pop()
    if len(restarts) == 1:
        return "restarts: seen"
    if _silent(restarts):
        return "restarts: silence"
    turned = all(any(restart.turned) for restart in restarts)
    return "restarts: motors" if turned else "restarts: seen"


def _silent(restarts: Sequence[Restart]) -> bool:
    return len(restarts) > 1 and all(restart.silent_s >= MIN_SILENCE_S for restart in restarts)


def _restart_texts(mcu: McuConfig, restart: Restart) -> tuple[str, str]:
    turned = [motor for motor, speed in enumerate(restart.turned) if speed]
    when = f"{motor_names(mcu, turned, ', ')} turned" if turned else "no motor turned"
    return when, restart.sign + (f" (reset={restart.cause})" if restart.cause else "")


def _times(count: int) -> str:
    return "" if count == 1 else "twice" if count == 2 else f"{count} times"
