"""Decides when a line may be written to the board: in every control period, and early if needed.

An early line is written between two periods: for a new command or mode, or after a press of the
emergency stop or a bumper. It replaces the line of the next period, so a flood of commands does not
cause more lines. The time from the previous line to an early line must be at least the wire time of
a line plus `BREATH_NS`. In each period, only one early line may be attempted.
"""

from __future__ import annotations

from msgspec import Struct


class Period(Struct, frozen=True):
    """The periods that have ended since the last step.

    `expired` is their number. `due_ns` is the monotonic time at which the first of them ended, ns.
    """

    expired: int
    due_ns: int


NO_PERIOD = Period(0, 0)


BREATH_NS = 1_000_000
"""Shortest time from the end of a line on the wire to an early line after it, ns. In this time the
board can reply."""

IDLE_WAKES = 3
"""Input from the bus can run extra steps in a period. After more than this number of them without
a new command or mode, further input waits for the next period. So a flood of messages costs
little."""


class Pace:
    """Decides when a line may be written.

    `sent_ns`, an argument of its methods, is the monotonic time of the last line, ns.
    """

    def __init__(self, line_ns: int, period_ns: int) -> None:
        self._gap_ns = line_ns + BREATH_NS
        self._possible = self._gap_ns < period_ns
        """Whether a period is long enough for an early line besides the line of a period."""
        self._ahead = False
        """Whether an early line was written in place of the next period's line."""
        self._tried = False
        """Whether an attempt to write an early line has been made in this period."""
        self._waiting = False
        """Whether a new command came too soon after the last line, so it has not been sent yet."""
        self._idle = 0

    def period_ended(self, missed: int) -> bool:
        """Record the end of a period, and return whether a line must be written for it.

        `missed` is the number of periods just before it that got no step. If an early line has
        replaced the line of this period, no line is needed unless periods were missed.
        """
        ahead, self._ahead, self._tried = self._ahead, False, False
        self._idle = 0
        return missed > 0 or not ahead

    def at_once(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether an early line may be written now, for example for a new command."""
        return self._possible and not self._tried and now_ns - sent_ns >= self._gap_ns

    def note(self, tick: bool, due: bool, went: bool, news: bool, heard: bool) -> None:
        """Record the result of a step.

        Args:
            tick: Whether the step had to write the line of a period. The line of any other step is
                an early line.
            due: Whether the step had a line to write.
            went: Whether the line was written.
            news: Whether the command or the mode has changed since the last line that was due, or
                the emergency stop or a bumper was pressed.
            heard: Whether the bus had input for this step.
        """
        self._waiting = news and not due
        self._idle += heard and not news
        if due and not tick:
            self._tried, self._ahead = True, went

    @property
    def listens(self) -> bool:
        """Whether a command that arrives now gets a step at once, not only in the next period."""
        return self._possible and not (self._tried or self._waiting or self._idle > IDLE_WAKES)

    @property
    def waits(self) -> bool:
        """Whether a new command waits because it came too soon after the last line."""
        return self._waiting and self._possible and not self._tried

    def retry_ns(self, sent_ns: int) -> int | None:
        """Return the monotonic time at which a waiting command may be sent, ns.

        Return None if no command waits.
        """
        return sent_ns + self._gap_ns if self.waits else None
