"""Monitors the safety inputs that the board reports, and decides when an input counts as pressed.

`BoardInput` is the common base class of `EmergencyStop` and of the bumpers (`bumpers.py`). A board
that has reported an input once must continue to report this input. After `SILENCE_TIMEOUT_S`
without a report, the input counts as pressed: a cable may be cut, or the emergency stop may have
cut the board's own supply. A pressed emergency stop latches a stop (`lifecycle.py`). The stop lasts
until a client calls `clear`.

When the serial port is opened again, a different board may answer, and this board may not have the
input. The input keeps its state until the board reports it, or until `session.py` finds that the
board does not report it.

This software is not the safety function: the hardware emergency stop cuts the power of the motors
without the daemon. The board only reports the press to the daemon. The daemon then commands zeros,
and keeps the robot stopped after the button is released.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import zip_longest
from typing import Literal

from acsard.core.config.settings import EstopUse
from acsard.core.link.board_status import BoardStatus
from acsard.core.values import NS_PER_S, EstopState, Event, EventName

Sign = Literal["ok", "pressed", "silence"]

TRANSITIONS: dict[tuple[EstopState, Sign], EstopState] = {
    ("", "ok"): "released",
    ("", "pressed"): "pressed",
    ("released", "pressed"): "pressed",
    ("released", "silence"): "silent",
    ("pressed", "ok"): "released",
    ("silent", "ok"): "released",
    ("silent", "pressed"): "pressed",
}
"""Maps the state of a safety input and a sign to the next state. The sign is `ok` or `pressed` if a
status line reports the input, and `silence` if no line has reported the input for
`SILENCE_TIMEOUT_S`. A pair without an entry does not change the state."""

SILENCE_TIMEOUT_S = 0.5
"""Time without a report after which an input counts as pressed, s: five status lines at 10 Hz."""

LATE_STEP_NS = 150_000_000
"""If two control steps are farther apart than this, ns, the second step counts as late. The longest
control period that can be configured is 100 ms."""

CATCH_UP_NS = 100_000_000
"""Extra time after a late control step before the board counts as silent, ns. In this time, the
daemon reads the lines and commands that arrived while no control step ran."""

PRESSED_REASON = "emergency stop pressed at the robot"
SILENT_REASON = (
    f"the board has not reported its emergency stop for {SILENCE_TIMEOUT_S:g} s, "
    "so it counts as pressed"
)

RELEASE, CHECK = "release it at the robot", "check the board and its cable"

MISSING_REASON = (
    'safety.estop = "required", but the microcontroller has not reported an emergency-stop input: '
    "does its firmware send status lines with `estop=`?"
)

DRIVER_FAULT_REASON = "the board reports a fault of a motor driver"
DRIVER_FAULT_ADVICE = "repair the driver, or switch the robot off and on"


class BoardInput(ABC):
    """The state of one safety input, or of several that the board always reports together."""

    table = TRANSITIONS
    silent: str
    """Reason, as text, of a stop that is latched because the board does not report the inputs."""
    events: tuple[EventName, EventName]
    """Names of the two log events for a press and for a release."""

    def __init__(self, use: EstopUse) -> None:
        self.use = use
        self.state: EstopState = ""
        """The state of the inputs; "" if the board has never reported them."""
        self.pressed: tuple[bool, ...] | None = None
        """Whether each input counts as pressed; None if the board has never reported the inputs."""
        self._awaited = True
        """True from the opening of the port until the board reports the inputs."""
        self.pressed_now = ""
        """Reason, as text, if an input began to count as pressed in the last call of
        `process_reports`; otherwise an empty text."""
        self._reported_ns = self._looked_ns = 0
        self._excused = False

    @property
    def why(self) -> str:
        """Why an input counts as pressed, as text; "" while no input counts as pressed."""
        if self.state == "silent":
            return self.silent
        return self.reason_text() if self.state == "pressed" else ""

    @property
    def mend(self) -> str:
        """Advice to the operator about an input that counts as pressed, as text."""
        return CHECK if self.state == "silent" else RELEASE

    @property
    def missing(self) -> bool:
        """Whether the robot needs the inputs, but the board has not reported them.

        Only reports since the serial port was last opened count. While this is true, the robot
        cannot drive.
        """
        return self.use == "required" and self._awaited

    def reopen(self) -> None:
        """Record that the serial port was opened, so that another board may answer from now on.

        The inputs keep their state until the board reports them, or until `forget` is called.
        """
        self._awaited = True

    def forget(self) -> None:
        """Forget the state if the board has not reported the inputs since the port was opened.

        Call this when it is certain that this board does not report the inputs. Otherwise, a press
        that an earlier board has reported would prevent `clear` forever.
        """
        if self._awaited:
            self.state, self.pressed = "", None

    def process_reports(
        self, reports: Sequence[tuple[int, BoardStatus]], now_ns: int
    ) -> list[Event]:
        """Process the status lines since the last control step; return the log events of changes.

        Each item of `reports` is a pair: the monotonic time of arrival, ns, and the status line.
        """
        self.pressed_now = ""
        if self.use == "off":
            return []
        events: list[Event] = []
        for at_ns, status in reports:
            pressed = self.read(status)
            if pressed is not None:
                self._reported_ns, self._excused, self._awaited = at_ns, False, False
                events += self._take("pressed" if any(pressed) else "ok", pressed)
        late, self._looked_ns = now_ns - self._looked_ns > LATE_STEP_NS, now_ns
        if self.pressed is not None and now_ns - self._reported_ns > _SILENT_NS:
            # Excuse a late step only once between two reports of the board. Otherwise a control
            # loop that is always late would delay the stop forever.
            if late and not self._excused:
                self._reported_ns, self._excused = now_ns - _SILENT_NS + CATCH_UP_NS, True
            else:
                events += self._take("silence", (True,) * len(self.pressed))
        return events

    @abstractmethod
    def read(self, status: BoardStatus) -> tuple[bool, ...] | None:
        """Return whether each input is pressed; None if `status` does not report the inputs."""

    @abstractmethod
    def reason_text(self) -> str:
        """Return the reason of a stop as text: it says which inputs are pressed."""

    @abstractmethod
    def released(self, before: EstopState) -> str:
        """Return the log text for inputs that are not pressed any more.

        `before` is the state before the release; "" if this is the first report of the inputs.
        """

    def advice(self) -> str:
        """Return the instruction that the log gives to the operator when an input is pressed."""
        return f"{self.mend}, then call srv/clear"

    def _take(self, sign: Sign, pressed: tuple[bool, ...]) -> list[Event]:
        before, was = self.state, self.pressed or ()
        self.state, self.pressed = self.table.get((before, sign), before), pressed
        more = any(now and not then for now, then in zip_longest(pressed, was, fillvalue=False))
        if self.state == before and not more:
            return []
        why = self.why
        if why:
            self.pressed_now = why
            return [Event(self.events[0], f"{why}; {self.advice()}", "error")]
        return [Event(self.events[1], self.released(before))]


class EmergencyStop(BoardInput):
    """The state of the emergency stop."""

    silent, events = SILENT_REASON, ("emergency_stop", "emergency_stop_released")

    def __init__(self, use: EstopUse, unpowered: bool = False) -> None:
        super().__init__(use)
        self.driver_fault = False
        """Whether a status line in the last call of `process_reports` reported a fault of a motor
        driver. Faults do not count while the drivers may be without power (`_unpowered`)."""
        self._unpowered = unpowered
        """Whether the emergency stop was pressed and its stop is still latched. The emergency stop
        cuts the power of the motor drivers, and a driver without power reports a fault. The power
        may come back some time after the button is released. Therefore no driver fault counts until
        `clear` has released the stop."""

    def process_reports(
        self, reports: Sequence[tuple[int, BoardStatus]], now_ns: int
    ) -> list[Event]:
        """Process the status lines since the last control step; return the log events of changes.

        Each item of `reports` is a pair: the monotonic time of arrival, ns, and the status line.
        The method also updates `driver_fault`.
        """
        self.driver_fault, pressed = False, bool(self.why)
        self._unpowered |= self.state == "pressed"
        for _, status in reports:
            if self.use != "off" and status.estop is not None:
                pressed = status.estop
                self._unpowered |= pressed
            self.driver_fault |= bool(status.driver_fault) and not (pressed or self._unpowered)
        events = super().process_reports(reports, now_ns)
        if self.why:
            self.driver_fault = False
        return events

    def powered(self) -> None:
        """Record that `clear` has released the stop, so that driver faults count from now on.

        Before that, the motor drivers may have no power, and a driver without power reports a
        fault.
        """
        self._unpowered = False

    def read(self, status: BoardStatus) -> tuple[bool, ...] | None:
        """Return `(status.estop,)`, or None if the status line does not report `estop`."""
        return None if status.estop is None else (status.estop,)

    def reason_text(self) -> str:
        return PRESSED_REASON

    def released(self, before: EstopState) -> str:
        if not before:
            return "the board reports an emergency-stop input, which is released"
        return "the emergency stop is released; the robot stays stopped until srv/clear is called"


_SILENT_NS = int(SILENCE_TIMEOUT_S * NS_PER_S)
