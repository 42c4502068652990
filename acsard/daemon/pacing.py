"""Decides when a line may be written to the board: in every control period, and early if needed.

An early line is for another speed or mode, or after a press of the emergency stop or a bumper. It
replaces the next period's, so a flood of commands causes no more lines. It comes after the wire
time of a line plus `REPLY_TIME_NS`, and only one is tried in a period.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.values import Ns


class Period(Struct, frozen=True):
    """The control periods that have ended since the last step, and when the first of them did."""

    expired: int
    due_ns: Ns


NO_PERIOD = Period(0, 0)


# Least time from the end of a line to an early one, in which the board can reply.
REPLY_TIME_NS = 1_000_000

# Steps in a period whose input brings no other speed or mode. Further input waits for the next
# period, so a flood takes little processor time.
MAX_IDLE_WAKES = 3


class Pace:
    """Decides when a line may be written; `sent_ns` is always the last line's time.

    After `record_step`, `early` says whether the next command gets an extra step and does not wait
    for another one, and `retry_ns` says when the command that waits may be sent; it is None without
    one.

    Args:
        line_ns: wire time of the longest line.
        period_ns: control period.
    """

    def __init__(self, line_ns: Ns, period_ns: Ns) -> None:
        self._gap_ns = line_ns + REPLY_TIME_NS
        self._possible = self._gap_ns < period_ns  # a period is long enough for an early line
        self._ahead = False  # an early line has replaced the next period's
        self._tried = False  # an early line, in this period
        self.waiting = False  # for a command that came too soon after the last line
        self._idle = 0
        self.early = self._possible
        self.retry_ns: Ns | None = None

    def period_ended(self, missed: int) -> bool:
        """Record the end of a period, and return whether its line must be written.

        It need not if an early line has replaced it and no period was missed.
        """
        ahead, self._ahead, self._tried = self._ahead, False, False
        self._idle = 0
        return missed > 0 or not ahead

    def at_once(self, now_ns: Ns, sent_ns: Ns) -> bool:
        """Return whether a line between two control periods may be written now."""
        return self._possible and not self._tried and now_ns - sent_ns >= self._gap_ns

    def record_step(
        self, tick: bool, due: bool, written: bool, changed: bool, had_input: bool, sent_ns: Ns
    ) -> None:
        """Record the result of a step. A step only with bytes changes nothing, unless `waiting`.

        `tick` says that it had to write a period's line, `due` that it had a line, `changed` that
        the command or the mode was new or an input was pressed, and `had_input` that the bus had
        any.
        """
        self.waiting = changed and not due
        self._idle += had_input and not changed
        if due and not tick:
            self._tried, self._ahead = True, written
        may_try = self._possible and not self._tried
        self.early = may_try and not self.waiting and self._idle <= MAX_IDLE_WAKES
        self.retry_ns = sent_ns + self._gap_ns if self.waiting and may_try else None
