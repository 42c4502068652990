"""When a line may go: every period, and at once for what is new.

A line that went at once takes the place of the next period's, so that a flood of commands makes no
more lines than the clock alone; and two lines are never closer than the wire needs and a little
more.
"""

from __future__ import annotations

BREATH_NS = 1_000_000
"""Beyond its time on the wire, what a line leaves the MCU to take it in and answer."""

IDLE_WAKES = 3
"""Steps a period that commands may cause without one of them counting: a stranger's flood costs no
more than this, and the command that counts still has a chance in each period to go at once."""


class Pace:
    """Remembers the last line and whether it has already taken the next period's place."""

    def __init__(self, line_ns: int) -> None:
        self._gap_ns = line_ns + BREATH_NS
        self._last_ns = -self._gap_ns
        self._ahead = False
        """A line has gone in the place of the next period's."""
        self._waiting = False
        """There was something new to say, too soon after a line."""
        self._idle = 0

    def tick(self) -> bool:
        """A period has ended: does its line go, or did one go in its place?"""
        ahead, self._ahead = self._ahead, False
        self._idle = 0
        return not ahead

    def at_once(self, now_ns: int) -> bool:
        """May a line go now, beside the clock, if there is something new to say?"""
        return not self._ahead and now_ns - self._last_ns >= self._gap_ns

    def note(self, now_ns: int, tick: bool, sent: bool, news: bool, heard: bool) -> None:
        """After a step: a line `sent` on its `tick` or at once, or `news` that could not go yet.

        `heard`: the bus had something for this step.
        """
        self._waiting = news and not sent and not tick
        self._idle += heard and not tick and not news
        if sent:
            self._last_ns = now_ns
            self._ahead = not tick

    @property
    def listens(self) -> bool:
        """Worth waking for a command: none is in hand, and a line could go before the tick."""
        return not (self._ahead or self._waiting or self._idle > IDLE_WAKES)

    @property
    def retry_ns(self) -> int | None:
        """When the line for what is new may go, if that is before the tick; None for never."""
        return self._last_ns + self._gap_ns if self._waiting and not self._ahead else None
