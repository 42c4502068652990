"""Neutral first: whether one sender may drive, by what it has sent since that was required.

    unheard  nothing of it has been heard yet
    heard    it commands, and has not let go
    free     it has let go: it may drive, until neutral is required again

It lets go by a zero that no speed came shortly before, or by a pause of its own doing. What lives
here: one sender's last command and its state. What must not: which sender is followed
(`arbiter.py`).
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Literal

from acsard.values import REST, Command

State = Literal["unheard", "heard", "free"]
Sign = Literal["moving", "zero", "pause"]
"""`moving` is a speed, or a zero among speeds: others may look like this sender."""

NEXT: dict[tuple[State, Sign], State] = {
    ("unheard", "moving"): "heard",
    ("unheard", "zero"): "free",
    ("unheard", "pause"): "heard",  # who was not heard cannot pause
    ("heard", "moving"): "heard",
    ("heard", "zero"): "free",
    ("heard", "pause"): "free",
}
"""What a command shows, and what that leads to. Who is free stays so."""

INTERVALS = 5
"""A sender's usual interval is the median of so many: a stall among them does not make it."""


class Sender:
    """One sender of a source: two programs, or two people, on one key are two."""

    def __init__(self, timeout_ns: int, pause_ns: int, state: State) -> None:
        self.use(timeout_ns, pause_ns)
        self.state = self._sure = state
        """Also by what does not count yet; and only by what does."""
        self.name = ""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Its last command that counted, since neutral was last required."""
        self.came_ns = 0
        """First command since it was last silent: who came first."""
        self.zeros_ns: int | None = None
        """First of the zeros that it has sent without a speed since; None when it sent one."""
        self.ros = False
        """It sends from ROS."""
        self.noticed_ns = 0
        """Last sign of it, whether that counted or not."""
        self.doubted_ns: int | None = None
        """Last command of it that did not count for when it was sent."""
        self._moved_ns: int | None = None
        """Its last speed, or what may have been one."""
        self._intervals: deque[int] = deque(maxlen=INTERVALS)
        """How far its last speeds were apart."""
        self._stamp_ns: int | None = None
        """When it says that it sent the last command that could be believed."""
        self._sequence: int | None = None

    def use(self, timeout_ns: int, pause_ns: int) -> None:
        """Go by these from now on."""
        self._timeout_ns, self._pause_ns = timeout_ns, pause_ns

    def live(self, now_ns: int) -> bool:
        """Its last command is no older than the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def doubtful(self, now_ns: int) -> bool:
        """Nothing of it counts because of when that was sent."""
        return self.doubted_ns is not None and now_ns - self.doubted_ns <= self._timeout_ns

    def forget(self, state: State) -> None:
        """What it has sent until now counts no more."""
        self.arrived_ns = self._stamp_ns = None
        self.state = self._sure = state

    def unlearn(self) -> None:
        """What did not count until now never will."""
        self.state = self._sure

    def notice(self, at_ns: int) -> None:
        """Something of it that does not count came in: it may have been a speed."""
        if self._moved_ns is not None:
            self._intervals.append(at_ns - self._moved_ns)
        self._moved_ns = self.noticed_ns = at_ns

    def take(self, command: Command, since_ns: int, *, counts: bool = True) -> None:
        """A command of it, which says nothing of neutral if it arrived before `since_ns`.

        One that does not count yet makes it neutral all the same, but not live.
        """
        now_ns = command.arrived_ns
        if now_ns >= since_ns and self.state != "free":
            self.state = NEXT[self.state, self._sign(command)]
        self._stamp_ns, self._sequence = command.stamp_ns, command.sequence
        if is_zero(command):
            self.noticed_ns = now_ns
        else:
            self.notice(now_ns)
        if not counts:
            self.doubted_ns = now_ns
            return
        live = self.live(now_ns)
        if not live:
            self.came_ns = now_ns
        if not is_zero(command):
            self.zeros_ns = None
        elif self.zeros_ns is None or not live:
            self.zeros_ns = now_ns
        self.ros = command.ros
        self._sure, self.name = self.state, command.sender
        self.twist, self.arrived_ns, self.doubted_ns = command.twist, now_ns, None

    def _sign(self, command: Command) -> Sign:
        if is_zero(command) and self._let_go(command):
            return "zero"
        return "pause" if self._paused(command) else "moving"

    def _let_go(self, command: Command) -> bool:
        """No speed came for so long before that nobody can be in the midst of sending them."""
        if self._moved_ns is None:
            return True
        usual = self._usual or 0.0
        enough = max(self._timeout_ns, min(1.5 * usual, self._pause_ns))
        if command.shared:  # whose zero it is, nobody knows
            enough = max(self._timeout_ns, self._pause_ns + min(usual, self._pause_ns))
        return command.arrived_ns - self._moved_ns > enough

    def _paused(self, command: Command) -> bool:
        """It was silent for clearly longer than it usually is, by its own doing."""
        usual = self._usual
        if usual is None:
            return False  # all one knows this may be how often it sends
        longest = self._longest_ns(usual)
        if command.arrived_ns - self.noticed_ns <= longest:
            return False
        # Or was the network silent?
        sent, before = command.stamp_ns, self._stamp_ns
        if sent is not None and before is not None and sent - before <= longest:
            return False
        number, last = command.sequence, self._sequence
        return number is None or last is None or number == last + 1

    def _longest_ns(self, usual: float) -> float:
        """Silence that is no pause yet: it began when its next speed was due."""
        return max(self._timeout_ns, self._pause_ns + usual, 3 * usual)

    @property
    def _usual(self) -> float | None:
        """How far its speeds are apart, ns; None until that shows."""
        return median(self._intervals) if self._intervals else None


def is_zero(command: Command) -> bool:
    """It asks for rest, and not because opposites cancel out."""
    return command.twist == REST and not command.cancelled
