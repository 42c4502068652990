"""The promises about the log: it contains each change of the mode, and its rate is limited.

`reference/events.md` of the manual states them. Times are in ns of the robot's monotonic clock.
"""

from __future__ import annotations

from tests.simulate.product import StepResult
from tests.simulate.promises import BrokenError
from tests.simulate.roads import NS

BURST = 5
"""Lines of one name that may come at once. From then on one comes in each second."""

LATE_NS = 6 * NS
"""A change may be logged this late: after a burst, repetitions wait until it is paid for."""

LEVELS = {"debug", "info", "warning", "error"}


class LogLines:
    """Judges the log lines of one daemon."""

    def __init__(self) -> None:
        self._paid_ns: dict[str, int] = {}
        """Time at which the lines of each name are paid for, at a second each."""
        self._mode = self._awaited = ""
        """The mode, and the words of a line that the log lacks."""
        self._since_ns = 0
        """Since when it lacks them."""

    def see(self, true_ns: int, snapshot: StepResult) -> None:
        """Judge the lines of one step."""
        now_ns = snapshot.decided_ns
        if snapshot.mode != self._mode:
            # A daemon that starts does not log its first mode as a change.
            self._awaited = f"-> {snapshot.mode}" if self._mode else ""
            self._mode, self._since_ns = snapshot.mode, now_ns
        names = {name for name, _, _ in snapshot.events}
        for name, level, text in snapshot.events:
            if {"stop", "clear"} <= names and name in ("stop", "clear"):
                continue  # the one that waited comes with the other one, and is not charged
            paid_ns = max(self._paid_ns.get(name, 0), now_ns)
            self._paid_ns[name] = paid_ns + NS
            if paid_ns - now_ns > BURST * NS:
                text = f"{name} more than {BURST} times at once: {text}"
                raise BrokenError("the log is not flooded", true_ns, text)
            if level not in LEVELS or not text or "\n" in text:
                raise BrokenError("every line of the log has a text", true_ns, f"{name}: {text!r}")
            if name == "mode" and self._awaited in text:
                self._awaited = ""
        if self._awaited and now_ns - self._since_ns > LATE_NS:
            text = f"no line has {self._awaited!r}"
            raise BrokenError("a change of the mode is logged", true_ns, text)
