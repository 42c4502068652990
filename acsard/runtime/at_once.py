"""When a line may go: every period, and at once for what is new.

A line that went at once takes the place of the next period's, so that a flood of commands makes no
more lines than the clock alone; and it keeps a distance to the line before it: what that takes on
the wire and a little more. Each period has one try.
"""

from __future__ import annotations

BREATH_NS = 1_000_000
"""Beyond its time on the wire, what a line leaves the MCU to take it in and answer."""

IDLE_WAKES = 3
"""Steps a period that commands may cause without one of them counting: a stranger's flood costs no
more than this, and the command that counts still has a chance in each period to go at once."""


class Pace:
    """Remembers whether a line has already taken the next period's place.

    When the last line went is the port's to know; it is an argument here.
    """

    def __init__(self, line_ns: int, period_ns: int) -> None:
        self._gap_ns = line_ns + BREATH_NS
        self._possible = self._gap_ns < period_ns
        """Else the next period always comes before a line may go."""
        self._ahead = False
        """A line has gone in the place of the next period's."""
        self._tried = False
        """This period's line has been offered, whether or not it went."""
        self._waiting = False
        """There was something new to say, too soon after a line."""
        self._idle = 0

    def period_ended(self, missed: int) -> bool:
        """Does the clock's line go (`Inputs.tick`), or did one go in its place?

        After `missed` periods it goes in any case: the one before it is long ago.
        """
        ahead, self._ahead, self._tried = self._ahead, False, False
        self._idle = 0
        return missed > 0 or not ahead

    def at_once(self, now_ns: int, sent_ns: int) -> bool:
        """May a line go now, beside the clock, if there is something new to say?"""
        return self._possible and not self._tried and now_ns - sent_ns >= self._gap_ns

    def note(self, tick: bool, due: bool, went: bool, news: bool, heard: bool) -> None:
        """After a step: was its line the clock's, was one `due`, did it go?

        `news` is what the next line has to say that the last did not; `heard` that the bus had
        something for this step.
        """
        self._waiting = news and not due
        self._idle += heard and not news
        if due and not tick:
            self._tried, self._ahead = True, went

    @property
    def listens(self) -> bool:
        """Worth waking for a command: none is in hand; a line could go before the next period."""
        return self._possible and not (self._tried or self._waiting or self._idle > IDLE_WAKES)

    def retry_ns(self, sent_ns: int) -> int | None:
        """When the line for what is new may go, if before the next period; None for never."""
        ahead = self._waiting and self._possible and not self._tried
        return sent_ns + self._gap_ns if ahead else None
