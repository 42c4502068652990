"""Neutral first: whether one sender may drive, by what it has sent since that was required.

    unheard  nothing of it has counted yet
    heard    it commands, and has not let go
    free     it has let go: it may drive, until neutral is required again

It lets go by a zero, or by a pause of its own doing. What lives here: one sender's last command
and its state. What must not: which sender is followed (`arbiter.py`).
"""

from __future__ import annotations

from typing import Literal

from acsard.values import REST, Command

State = Literal["unheard", "heard", "free"]
Sign = Literal["moving", "zero", "pause"]

NEXT: dict[tuple[State, Sign], State] = {
    ("unheard", "moving"): "heard",
    ("unheard", "zero"): "free",
    ("unheard", "pause"): "heard",  # who was not heard cannot pause
    ("heard", "moving"): "heard",
    ("heard", "zero"): "free",
    ("heard", "pause"): "free",
    ("free", "moving"): "free",
    ("free", "zero"): "free",
    ("free", "pause"): "free",
}
"""What a command that counts shows, and what that leads to."""


class Sender:
    """One sender of a source: two programs, or two people, on one key are two."""

    def __init__(self, timeout_ns: int, state: State) -> None:
        self._timeout_ns = timeout_ns
        self.state = state
        self.name = ""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Its last command that counted, since neutral was last required."""
        self.came_ns = 0
        """First command since it was last silent: who came first."""
        self.noticed_ns = 0
        """Last sign of it, whether that counted or not."""
        self._stamp_ns: int | None = None
        """When it says that it sent the last command that counted."""

    def live(self, now_ns: int) -> bool:
        """Its last command is no older than the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def forget(self, state: State) -> None:
        """What it has sent until now counts no more."""
        self.arrived_ns = self._stamp_ns = None
        self.state = state

    def take(self, command: Command, since_ns: int) -> None:
        """A command of it that counts, as neutral too unless it arrived before `since_ns`."""
        now_ns = command.arrived_ns
        if now_ns >= since_ns:
            self.state = NEXT[self.state, self._sign(command)]
        if not self.live(now_ns):
            self.came_ns = now_ns
        self.twist, self._stamp_ns = command.twist, command.stamp_ns
        self.name = command.sender
        self.arrived_ns = self.noticed_ns = now_ns

    def _sign(self, command: Command) -> Sign:
        if command.twist == REST and not command.cancelled:
            return "zero"
        if command.arrived_ns - self.noticed_ns <= self._timeout_ns:
            return "moving"
        # Silent by its own doing, or was the network?
        sent, before = command.stamp_ns, self._stamp_ns
        own = sent is None or before is None or sent - before > self._timeout_ns
        return "pause" if own else "moving"
