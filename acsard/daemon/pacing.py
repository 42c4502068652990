"""Decides when a line may go: in every period, and at once for a new command or mode.

A line that goes at once replaces the line of the next period, so a flood of commands does not add
lines. It keeps a distance to the line before it: the wire time of that line and a margin. Each
period has one attempt.
"""

from __future__ import annotations

from msgspec import Struct


class Period(Struct, frozen=True):
    """The periods that ended since the last step, the first of them due at `due_ns`."""

    expired: int
    due_ns: int


NO_PERIOD = Period(0, 0)
"""The value for a step that another event than the timer caused."""


BREATH_NS = 1_000_000
"""Time that a line leaves the board for its answer, besides the wire time, ns."""

IDLE_WAKES = 3
"""Steps per period that commands without effect may cause. This bounds the cost of a stranger's
flood, and a command that counts can still go at once in each period."""


class Pace:
    """A record of whether a line has already replaced the line of the next period.

    The port knows when the last line went, so the methods take that time as an argument.
    """

    def __init__(self, line_ns: int, period_ns: int) -> None:
        self._gap_ns = line_ns + BREATH_NS
        self._possible = self._gap_ns < period_ns
        """Whether a line can go between two periods at all."""
        self._ahead = False
        """Whether a line has gone in place of the next period's line."""
        self._tried = False
        """Whether this period's attempt has been made, successful or not."""
        self._waiting = False
        """Whether a new command came too soon after a line and waits."""
        self._idle = 0

    def period_ended(self, missed: int) -> bool:
        """Note the end of a period. Return whether its line goes (`Inputs.tick`).

        It does not go if a line went in its place. After `missed` periods it goes in any case,
        because the line before it left long ago.
        """
        ahead, self._ahead, self._tried = self._ahead, False, False
        self._idle = 0
        return missed > 0 or not ahead

    def at_once(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether a new command may go now, between two periods."""
        return self._possible and not self._tried and now_ns - sent_ns >= self._gap_ns

    def note(self, tick: bool, due: bool, went: bool, news: bool, heard: bool) -> None:
        """Note the result of a step.

        Args:
            tick: Whether its line was the period's.
            due: Whether it had a line to send.
            went: Whether the line left.
            news: Whether the next line differs from the last one.
            heard: Whether the bus had input for this step.
        """
        self._waiting = news and not due
        self._idle += heard and not news
        if due and not tick:
            self._tried, self._ahead = True, went

    @property
    def listens(self) -> bool:
        """Whether a command that arrives now is worth a step of its own."""
        return self._possible and not (self._tried or self._waiting or self._idle > IDLE_WAKES)

    @property
    def waits(self) -> bool:
        """Whether a new command waits, because the last line has only just left."""
        return self._waiting and self._possible and not self._tried

    def retry_ns(self, sent_ns: int) -> int | None:
        """Return the monotonic time at which a waiting command may go, or None if none waits."""
        return sent_ns + self._gap_ns if self.waits else None
