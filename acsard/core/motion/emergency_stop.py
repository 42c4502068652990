"""Monitors the safety inputs that the board reports, and decides when one counts as pressed.

An input that was reported once counts as pressed after `SILENCE_TIMEOUT_S` without a report: a
cable may be cut, or the emergency stop may have cut the board's own supply. A port that is lent is
silent on purpose: no silence counts until the link is up again. A pressed emergency stop latches a
stop until `clear`. After the port was opened, another board may answer, and the input keeps its
state until it is reported, or until `session.py` finds that it is not. The safety function is the
hardware, which cuts the motors' power without the daemon.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import ClassVar, Literal

from msgspec import Struct

from acsard.core.codes import Reason, reason, sentence
from acsard.core.config.settings import EstopUse, SafetyConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.link.step_times import CATCH_UP_NS
from acsard.core.values import NS_PER_S, EstopState, Event, EventName, Ns

Sign = Literal["ok", "pressed", "silence"]

# `silence`: no report for `SILENCE_TIMEOUT_S`. A pair without an entry changes nothing.
TRANSITIONS: dict[tuple[EstopState, Sign], EstopState] = {
    ("", "ok"): "released",
    ("", "pressed"): "pressed",
    ("released", "pressed"): "pressed",
    ("released", "silence"): "silent",
    ("pressed", "ok"): "released",
    ("silent", "ok"): "released",
    ("silent", "pressed"): "pressed",
}

SILENCE_TIMEOUT_S = 0.5  # five status lines at 10 Hz

PRESSED_REASON = reason("emergency_stop")
SILENT_REASON = reason("emergency_stop_silent", seconds=SILENCE_TIMEOUT_S)
MISSING_REASON = sentence("emergency_stop_missing")
DRIVER_FAULT_REASON = reason("driver_fault")


class BoardInput(Struct):
    """The state of one safety input, or of several that the board always reports together."""

    table: ClassVar[dict[tuple[EstopState, Sign], EstopState]] = TRANSITIONS
    silent: ClassVar[Reason]  # of a stop that is latched because the inputs are not reported
    events: ClassVar[tuple[EventName, EventName]]  # for a press and for a release

    state: EstopState = ""  # "" if never reported
    pressed: tuple[bool, ...] | None = None  # None if never reported
    awaited: bool = True  # until the board on the newly opened port reports the inputs
    lent: bool = False  # the port is lent, or the link was not up since the loan
    pressed_now: Reason | None = None  # by the last `process_reports`
    reported_ns: Ns = 0
    excused: bool = False  # a late step, since the last report

    def why(self, safety: SafetyConfig) -> Reason | None:
        """Return why an input counts as pressed; None if none does."""
        if self.state == "silent":
            return self.silent
        return self.pressed_reason(safety) if self.state == "pressed" else None

    def missing(self, safety: SafetyConfig) -> bool:
        """Return whether the robot needs the inputs, but the board has not reported them.

        While this is true, the robot cannot drive.
        """
        return self.awaited and self.use(safety) == "required"

    def reopen(self) -> None:
        """Record that the port was opened; the state stays until a report or `forget`."""
        self.awaited = True

    def lend(self) -> None:
        """Record that the port is lent to another program."""
        self.lent = True

    def forget(self) -> None:
        """Forget the state if the board is certain not to report the inputs.

        Otherwise, a press that an earlier board has reported would prevent `clear` forever.
        """
        if self.awaited:
            self.state, self.pressed = "", None

    def process_reports(
        self,
        reports: Sequence[tuple[int, BoardStatus]],
        now_ns: Ns,
        safety: SafetyConfig,
        *,
        up: bool,
        late: bool,
    ) -> list[Event]:
        """Process status lines with their arrival in a step; return the events of changes.

        `up` says that the link is up, and `late` that this step is late.
        """
        self.pressed_now = None
        if self.use(safety) == "off":
            return []
        events: list[Event] = []
        for at_ns, status in reports:
            pressed = self.read(status, safety)
            if pressed is not None:
                self.reported_ns, self.excused, self.awaited = at_ns, False, False
                events += self._take("pressed" if any(pressed) else "ok", pressed, safety)
        if self.lent:
            self.reported_ns, self.lent = now_ns, not up
        if self.pressed is not None and now_ns - self.reported_ns > _SILENT_NS:
            # Excuse a late step once between two reports, or a loop that is always late would delay
            # the stop forever.
            if late and not self.excused:
                self.reported_ns, self.excused = now_ns - _SILENT_NS + CATCH_UP_NS, True
            else:
                events += self._take("silence", (True,) * len(self.pressed), safety)
        return events

    def use(self, safety: SafetyConfig) -> EstopUse:
        raise NotImplementedError

    def read(self, status: BoardStatus, safety: SafetyConfig) -> tuple[bool, ...] | None:
        """Return whether each input is pressed; None if `status` does not report them."""
        raise NotImplementedError

    def pressed_reason(self, safety: SafetyConfig) -> Reason:
        """Return which inputs are pressed, as the reason of a stop."""
        raise NotImplementedError

    def released(self, before: EstopState, safety: SafetyConfig) -> str:
        """Return the text of a release; `before` is "" for the first report of the inputs."""
        raise NotImplementedError

    def advice(self, why: Reason, safety: SafetyConfig) -> str:
        """Return the instruction to the operator when an input is pressed."""
        return f"{why.advice}, then type `acsard call clear`"

    def _take(self, sign: Sign, pressed: tuple[bool, ...], safety: SafetyConfig) -> list[Event]:
        before, was = self.state, self.pressed or ()
        self.state, self.pressed = self.table.get((before, sign), before), pressed
        more = any(now and not then for now, then in zip_longest(pressed, was, fillvalue=False))
        if self.state == before and not more:
            return []
        why = self.why(safety)
        if why is not None:
            self.pressed_now = why
            text = f"{why.text}; {self.advice(why, safety)}"
            return [Event(self.events[0], text, "error", code=why.code)]
        return [Event(self.events[1], self.released(before, safety))]


class EmergencyStop(BoardInput):
    """The state of the emergency stop."""

    silent: ClassVar[Reason] = SILENT_REASON
    events: ClassVar[tuple[EventName, EventName]] = ("emergency_stop", "emergency_stop_released")

    driver_fault: bool = False  # in the last `process_reports`, while the drivers have power
    # The stop cuts the drivers' power, and one without power reports a fault. It may come back
    # late, so no such fault counts until `clear`.
    unpowered: bool = False

    def process_reports(
        self,
        reports: Sequence[tuple[int, BoardStatus]],
        now_ns: Ns,
        safety: SafetyConfig,
        *,
        up: bool,
        late: bool,
    ) -> list[Event]:
        self.driver_fault, pressed = False, self.is_pressed
        self.unpowered |= self.state == "pressed"
        for _, status in reports:
            if safety.estop != "off" and status.estop is not None:
                pressed = status.estop
                self.unpowered |= pressed
            self.driver_fault |= bool(status.driver_fault) and not (pressed or self.unpowered)
        events = super().process_reports(reports, now_ns, safety, up=up, late=late)
        if self.is_pressed:
            self.driver_fault = False
        return events

    @property
    def is_pressed(self) -> bool:
        """Whether the stop counts as pressed."""
        return self.state in ("pressed", "silent")

    def powered(self) -> None:
        """Record that `clear` has released the stop, so that driver faults count from now on."""
        self.unpowered = False

    def use(self, safety: SafetyConfig) -> EstopUse:
        return safety.estop

    def read(self, status: BoardStatus, safety: SafetyConfig) -> tuple[bool, ...] | None:
        return None if status.estop is None else (status.estop,)

    def pressed_reason(self, safety: SafetyConfig) -> Reason:
        return PRESSED_REASON

    def released(self, before: EstopState, safety: SafetyConfig) -> str:
        if not before:
            return "the board reports an emergency-stop input, which is released"
        return "the emergency stop is released; the robot stays stopped until `acsard call clear`"


_SILENT_NS = int(SILENCE_TIMEOUT_S * NS_PER_S)
