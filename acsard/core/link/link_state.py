"""Decides, with a state machine, whether the link to the board is good enough to drive.

The inputs are received lines, silences and changes of the port. The states are:

- down: the port is closed.
- booting: the port was opened, or the board has restarted while the link was up. Fewer than
  GOOD_LINES good lines in a row have come since.
- up: good lines arrive in time.
- stale: the link was up until one of these happened:

  - No good line came for `Link.quiet_ns`.
  - BAD_LINES bad lines came in a row on a checked link.
  - The open port wrote no line for `WATCHDOG_S`, the watchdog time of the board.
  - The received lines were the daemon's own lines (an echo).
"""

from __future__ import annotations

from typing import Literal

from acsard.core.values import NS_PER_S

State = Literal["down", "booting", "up", "stale"]
Input = Literal["closed", "opened", "restarted", "trusted", "silent", "damaged", "blocked", "echo"]

TRANSITIONS: dict[tuple[State, Input], State] = {
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
"""Maps each pair of a state and an input (`Input`) to the next state. A pair without an entry does
not change the state."""

STATE_TEXTS: dict[State, str] = {
    "down": "the serial port is closed; it is being reopened",
    "booting": "the port is open; waiting for the microcontroller's first good lines",
    "up": "the link to the microcontroller is up",
    "stale": "the microcontroller has fallen silent",
}

WATCHDOG_S = 0.3
"""Time without a valid line from the daemon after which the board stops the motors, s."""

WATCHDOG_NS = int(WATCHDOG_S * NS_PER_S)

GOOD_LINES = 3
"""Number of good lines in a row after which the link comes up. Fewer good lines prove little,
because a board may print anything after a reset."""

BAD_LINES = 5
"""If this many lines in a row are bad on a checked link (a link whose lines have checksums), the
daemon negotiates the checksum again."""

SPARSE_SILENCES = 2
"""After this many silences in a row, the lines of the board count as too sparse. Silences are in a
row if only one good line comes between two of them. A single silence only means that the link was
lost for a moment."""


class Link:
    """The state of the link, and its counts of good and bad lines.

    Only `apply` changes the state.
    """

    def __init__(self, quiet_ns: int) -> None:
        """Start with the port closed.

        `quiet_ns` is the duration of silence after which the link is stale, ns.
        """
        self.quiet_ns = quiet_ns
        self.state: State = "down"
        self.sparse_s = 0.0
        """Time between the last two good lines, s, after `SPARSE_SILENCES` silences in a row; else
        0."""
        self._silences = 0
        self._good_in_row = self._bad_in_row = 0
        self._heard_ns: int | None = None
        self._waits_until_ns, self._waited = 0, False
        """`_waits_until_ns` is the monotonic time until which the board may answer late, ns.
        `_waited` is true if `wait` was called since the last good line."""

    def apply(self, trigger: Input) -> None:
        """Change the state as `TRANSITIONS` says for the input `trigger`.

        Every input except "trusted" resets the count of good lines in a row.
        """
        self.state = TRANSITIONS.get((self.state, trigger), self.state)
        if trigger == "trusted":
            return
        self._good_in_row = 0
        if trigger in ("closed", "opened", "restarted"):
            self._heard_ns = None
        if trigger in ("closed", "opened"):
            self._bad_in_row = 0
            self.reset_silences()

    def silent(self, now_ns: int) -> bool:
        """Return whether the last good line is older than `quiet_ns`.

        The result is also True if no good line has come since the port was opened or the board
        restarted. It is False during the additional time that `wait` gives the board. `now_ns` is
        monotonic.
        """
        if self._heard_ns is None:
            return True
        return now_ns - self._heard_ns > self.quiet_ns and now_ns > self._waits_until_ns

    def good(self, at_ns: int) -> int | None:
        """Count a good line, which the daemon received at the monotonic time `at_ns`.

        Return the time since the previous good line, ns, or None for the first good line after the
        port was opened or the board has restarted.
        """
        since_ns = None if self._heard_ns is None else at_ns - self._heard_ns
        if not self.silent(at_ns):
            self.reset_silences()
        else:
            self.reset_good_lines()
            if since_ns is not None:
                self._silences += 1
                self.sparse_s = since_ns / NS_PER_S if self._silences >= SPARSE_SILENCES else 0.0
        self._good_in_row += 1
        self._bad_in_row = 0
        self._heard_ns, self._waited = at_ns, False
        return since_ns

    def wait(self, now_ns: int) -> None:
        """Give the board additional time to answer: a third of `quiet_ns`.

        The caller does this if it sent no line for a while, because the board may have had nothing
        to answer. The call has an effect only while the link is up, and only once after each good
        line. Therefore the link becomes stale in any case if no good line comes for the sum of
        three times: `quiet_ns`, the time without sent lines, and `quiet_ns` / 3. `now_ns` is
        monotonic.
        """
        if self.state == "up" and not self._waited:
            self._waited = True
            self._waits_until_ns = now_ns + self.quiet_ns // 3

    def reset_silences(self) -> None:
        """Reset the count of silences in a row.

        After `SPARSE_SILENCES` silences in a row, the board's lines count as too sparse. The caller
        resets the count if a line came in time, or if the board is not the cause of the silence.
        """
        self._silences, self.sparse_s = 0, 0.0

    def reset_good_lines(self) -> None:
        """Reset the count of good lines in a row, because of a bad line or a silence.

        While the link is up, the count does not change.
        """
        if self.state != "up":
            self._good_in_row = 0

    def bad(self) -> bool:
        """Count a bad line. Return True if this line completes `BAD_LINES` bad lines in a row.

        On a checked link, the caller must then negotiate the check again.
        """
        self.reset_good_lines()
        self._bad_in_row += 1
        return self._bad_in_row == BAD_LINES

    @property
    def damaged(self) -> bool:
        """Whether at least the last `BAD_LINES` lines were bad."""
        return self._bad_in_row >= BAD_LINES

    def judge(self, now_ns: int, may_rise: bool) -> None:
        """Change the state to "stale" after a silence, or to "up" after `GOOD_LINES` good lines.

        The state changes to "up" only if `may_rise` is true. `now_ns` is monotonic.
        """
        silent = self.silent(now_ns)
        if self.state == "up":
            if silent:
                self.apply("silent")
        elif self._good_in_row >= GOOD_LINES and may_rise and not silent:
            self.apply("trusted")
