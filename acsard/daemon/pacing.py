"""Decides when a line may be written to the board: in every control period, and early if needed.

An early line is written between two periods: for a new command or mode, or after a press of the
emergency stop or a bumper. It replaces the line of the next period, so a flood of commands does not
cause more lines. The time from the previous line to an early line must be at least the wire time of
a line plus `REPLY_TIME_NS`. In each period, the control loop may try only once to write an early
line.
"""

from __future__ import annotations

from msgspec import Struct


class Period(Struct, frozen=True):
    """The control periods that have ended since the last step.

    `expired` is the number of these periods. `due_ns` is the monotonic time at which the first of
    these periods ended, ns.
    """

    expired: int
    due_ns: int


NO_PERIOD = Period(0, 0)


REPLY_TIME_NS = 1_000_000
"""Shortest time from the end of a line on the wire to an early line after it, ns. An early line is
a line between two control periods. The board can reply in this time."""

MAX_IDLE_WAKES = 3
"""Limit for the idle steps in one control period. A step is idle if it had input from the bus that
brought no new command or mode. After more idle steps, further input waits for the next period, so
that a flood of messages takes little processor time."""


class Pace:
    """Decides when a line to the board may be written.

    In all methods, `sent_ns` is the monotonic time at which the last line was written, ns.

    Args:
        line_ns: time that the longest line takes on the wire, ns.
        period_ns: length of a control period, ns.
    """

    def __init__(self, line_ns: int, period_ns: int) -> None:
        self._gap_ns = line_ns + REPLY_TIME_NS
        self._possible = self._gap_ns < period_ns
        """Whether a period is long enough for an early line (a line between two periods)."""
        self._ahead = False
        """Whether an early line was written in place of the next period's line."""
        self._tried = False
        """Whether the control loop has tried to write an early line in this period."""
        self._waiting = False
        """Whether a new command has not been sent yet, because it came too soon after the last
        line."""
        self._idle = 0

    def period_ended(self, missed: int) -> bool:
        """Record the end of a period, and return whether a line must be written for this period.

        No line is needed if an early line has replaced the line of this period and no period was
        missed. `missed` is the number of periods just before this one that got no step.
        """
        ahead, self._ahead, self._tried = self._ahead, False, False
        self._idle = 0
        return missed > 0 or not ahead

    def at_once(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether a line between two control periods may be written now.

        `now_ns` is the present monotonic time, ns.
        """
        return self._possible and not self._tried and now_ns - sent_ns >= self._gap_ns

    def record_step(
        self, tick: bool, due: bool, written: bool, changed: bool, had_input: bool
    ) -> None:
        """Record the result of a step.

        Args:
            tick: whether the step had to write the line of a period. The line of any other step is
                an early line.
            due: whether the step had a line to write.
            written: whether the line was written.
            changed: whether the command or the mode has changed since the last line that was due,
                or the emergency stop or a bumper was pressed.
            had_input: whether the bus had input for this step.
        """
        self._waiting = changed and not due
        self._idle += had_input and not changed
        if due and not tick:
            self._tried, self._ahead = True, written

    @property
    def accepts_early_command(self) -> bool:
        """Whether the next command gets an extra step immediately.

        If False, the command waits for a step that another event runs, such as the end of the
        period.
        """
        return self._possible and not (self._tried or self._waiting or self._idle > MAX_IDLE_WAKES)

    def retry_ns(self, sent_ns: int) -> int | None:
        """Return the monotonic time at which the waiting command may be sent, ns.

        Return None if no command waits.
        """
        waits = self._waiting and self._possible and not self._tried
        return sent_ns + self._gap_ns if waits else None
