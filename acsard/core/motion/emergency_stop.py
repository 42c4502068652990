"""Follows the emergency-stop input that the board reports, and decides when it counts as pressed.

This is not the safety function. The hardware emergency stop cuts the motors by itself. The daemon
only learns of it, commands zeros, and keeps the robot stopped after the button is released.

A board that has reported the input once must go on: if it is silent about it for `SILENT_S`, the
input counts as pressed. A cable may be cut, or the emergency stop may have cut the board's own
supply. `lifecycle.py` keeps the latch, which only `clear` releases.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from acsard.core.config.settings import EstopUse
from acsard.core.values import NS_PER_S, EstopState, Event

Sign = Literal["ok", "pressed", "silence"]

TABLE: dict[tuple[EstopState, Sign], EstopState] = {
    ("", "ok"): "released",
    ("", "pressed"): "pressed",
    ("released", "pressed"): "pressed",
    ("released", "silence"): "silent",
    ("pressed", "ok"): "released",
    ("silent", "ok"): "released",
    ("silent", "pressed"): "pressed",
}
"""Maps (state, sign) to the next state. Without an entry the state stays."""

SILENT_S = 0.5
"""Seconds without a report of the input after which it counts as pressed. A board reports it ten
times a second, so five lines in a row are lost by then."""

LATE_NS = 150_000_000
"""Time between two steps, ns, that shows that this computer was late. The longest period is 100 ms.
"""

EXCUSE_NS = 100_000_000
"""Time that a late computer still waits for the lines that came meanwhile, ns. Only one lateness
between two reports is excused, so a computer that is always late does not wait for ever."""

PRESSED = "emergency stop pressed at the robot"
SILENT = f"the board reported no emergency-stop input for {SILENT_S:g} s, which counts as pressed"

WORDS: dict[EstopState, str] = {"pressed": PRESSED, "silent": SILENT}
"""Why the robot is stopped, in the states in which the input counts as pressed."""

MENDS: dict[str, str] = {PRESSED: "release it there", SILENT: "check the board and its cable"}
"""What to do before `clear`, for each of `WORDS`."""

MISSING = (
    'safety.estop = "required", but the microcontroller has not reported an emergency-stop input: '
    "does its firmware send status lines with `estop=`?"
)
"""Why the robot does not become ready, in words."""


class EmergencyStop:
    """The state of the input."""

    def __init__(self, use: EstopUse) -> None:
        self._use = use
        self.state: EstopState = ""
        """The state of the input; "" if the board has never reported it."""
        self.pressed_now = ""
        """Why the last `look` began to count the input as pressed, "" if it did not."""
        self._reported_ns = self._looked_ns = 0
        self._excused = False

    @property
    def held(self) -> str:
        """Why the input counts as pressed, in words; "" while it does not."""
        return WORDS.get(self.state, "")

    @property
    def missing(self) -> bool:
        """Whether the robot needs the input, and the board has never reported it."""
        return self._use == "required" and not self.state

    def look(self, reports: Iterable[tuple[int, bool | None]], now_ns: int) -> list[Event]:
        """Take the reports since the last step, and return the events of the changes.

        Args:
            reports: For each status line its monotonic time of arrival, ns, and whether the input
                is pressed, None if the line does not have the input.
            now_ns: Monotonic time of this step, ns.
        """
        self.pressed_now = ""
        if self._use == "off":
            return []
        events: list[Event] = []
        for at_ns, pressed in reports:
            if pressed is not None:
                self._reported_ns, self._excused = at_ns, False
                events += self._take("pressed" if pressed else "ok")
        late, self._looked_ns = now_ns - self._looked_ns > LATE_NS, now_ns
        if now_ns - self._reported_ns > _SILENT_NS:
            if late and not self._excused:
                self._reported_ns, self._excused = now_ns - _SILENT_NS + EXCUSE_NS, True
            else:
                events += self._take("silence")
        return events

    def _take(self, sign: Sign) -> list[Event]:
        before = self.state
        self.state = state = TABLE.get((before, sign), before)
        if state == before:
            return []
        why = WORDS.get(state, "")
        if why:
            self.pressed_now = why
            return [Event("emergency_stop", f"{why}; {MENDS[why]}, then call srv/clear", "error")]
        text = "released; the robot stays stopped until srv/clear"
        if not before:
            text = "the board reports an emergency-stop input, which is released"
        return [Event("emergency_stop_released", text)]


_SILENT_NS = int(SILENT_S * NS_PER_S)
