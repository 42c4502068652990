"""Can the link carry motion? What came, and how long nothing came, move it along a table.

down     the port is closed
booting  the port is open, or the MCU has restarted: fewer than GOOD_LINES good lines since
up       lines come in time, and right if they are checked
stale    it was up, then no good line for `quiet`, or BAD_LINES bad checked ones in a row, or
         no line of ours left for the board's watchdog time although the port is open, or
         the lines that came turned out to be our own
"""

from __future__ import annotations

from typing import Literal

from acsard.values import NS_PER_S

State = Literal["down", "booting", "up", "stale"]
Sign = Literal["closed", "opened", "restarted", "trusted", "silent", "damaged", "blocked", "echo"]

TABLE: dict[tuple[State, Sign], State] = {
    ("down", "opened"): "booting",
    ("booting", "closed"): "down",
    ("booting", "opened"): "booting",
    ("booting", "trusted"): "up",
    ("up", "closed"): "down",
    ("up", "opened"): "booting",
    ("up", "restarted"): "booting",
    ("up", "silent"): "stale",
    ("up", "damaged"): "stale",
    ("up", "blocked"): "stale",
    ("up", "echo"): "stale",
    ("stale", "closed"): "down",
    ("stale", "opened"): "booting",
    ("stale", "trusted"): "up",
}
"""Where a sign leads; without an entry it changes nothing."""

WORDS: dict[State, str] = {
    "down": "the serial port is closed; it is being reopened",
    "booting": "the port is open; waiting for the microcontroller's first good lines",
    "up": "linked",
    "stale": "the microcontroller has fallen silent",
}

GOOD_LINES = 3
"""Good lines before the link is trusted: a board that just reset prints anything for a while."""

BAD_LINES = 5
"""Bad lines in a row after which a checked link is asked anew."""


SPARSE = 2
"""Silences in a row between single good lines; one alone is a link that was lost for a moment."""


class Link:
    """Counts good and bad lines; `sign` alone moves the state."""

    def __init__(self, quiet_ns: int) -> None:
        """`quiet_ns` of silence make the link stale."""
        self.quiet_ns = quiet_ns
        self.state: State = "down"
        self.sparse_s = 0.0
        """Time between the last two good lines when again it was too long for the link, else 0."""
        self._silences = 0
        """So many in a row, each ended by one good line."""
        self._good_in_row = self._bad_in_row = 0
        self._heard_ns: int | None = None

    def sign(self, sign: Sign) -> None:
        """Go where the table says; but for trust itself, trust has to be earned anew."""
        self.state = TABLE.get((self.state, sign), self.state)
        if sign == "trusted":
            return
        self._good_in_row = 0
        if sign in ("closed", "opened", "restarted"):
            self._heard_ns = None
        if sign in ("closed", "opened"):
            self._bad_in_row = 0
            self.excuse()

    def silent(self, now_ns: int) -> bool:
        """No good line within `quiet`, or none at all in this session."""
        return self._heard_ns is None or now_ns - self._heard_ns > self.quiet_ns

    def good(self, at_ns: int) -> int | None:
        """Count a good line; the time since the one before, None for the first of a session."""
        since_ns = None if self._heard_ns is None else at_ns - self._heard_ns
        if not self.silent(at_ns):
            self.excuse()
        else:
            self.missed()
            if since_ns is not None:
                self._silences += 1
                self.sparse_s = since_ns / NS_PER_S if self._silences >= SPARSE else 0.0
        self._good_in_row += 1
        self._bad_in_row = 0
        self._heard_ns = at_ns
        return since_ns

    def excuse(self) -> None:
        """The last good lines were no sparse ones: in time, or it was not the board that waited."""
        self._silences, self.sparse_s = 0, 0.0

    def missed(self) -> None:
        """What came, or did not, is no reason to trust the link; a link that is up stays so."""
        if self.state != "up":
            self._good_in_row = 0

    def bad(self) -> bool:
        """Count a line that is none; True when so many came in a row that it is time to ask."""
        self.missed()
        self._bad_in_row += 1
        return self._bad_in_row == BAD_LINES

    @property
    def damaged(self) -> bool:
        """The last lines that came were bad ones."""
        return self._bad_in_row >= BAD_LINES

    def judge(self, now_ns: int, may_rise: bool) -> None:
        """Bring it up to date; `may_rise` unless there is a reason against trust just now."""
        silent = self.silent(now_ns)
        if self.state == "up":
            if silent:
                self.sign("silent")
        elif self._good_in_row >= GOOD_LINES and may_rise and not silent:
            self.sign("trusted")
