"""Decides, with a state machine, whether the link to the board is good enough to drive.

- down: the port is closed.
- booting: the port was opened or the board restarted; too few good lines in a row.
- up: good lines arrive in time.
- stale: no good line for `quiet_ns`, BAD_LINES bad ones in a row on a checked link, no line written
  for `WATCHDOG_S`, or the lines only repeat the daemon's own.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns

LinkState = Literal["down", "booting", "up", "stale"]
Input = Literal[
    "closed", "opened", "restarted", "trusted", "silent", "damaged", "blocked", "repeated"
]

# A pair without an entry does not change the state.
TRANSITIONS: dict[tuple[LinkState, Input], LinkState] = {
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
    ("up", "repeated"): "stale",
    ("stale", "closed"): "down",
    ("stale", "opened"): "booting",
    ("stale", "trusted"): "up",
}

WATCHDOG_S = 0.3  # without a valid line, the board stops the motors

WATCHDOG_NS = int(WATCHDOG_S * NS_PER_S)

# In a row, for a link. A board may print anything after a reset, but a checksum proves a line.
GOOD_LINES, CHECKED_LINES = 3, 1

NEVER_HEARD: Ns = -1  # before the time of any step

BAD_LINES = 5  # in a row on a checked link: the link is stale

# Silences with one good line between two that show too sparse lines. One shows a lost link.
SPARSE_SILENCES = 2


class Link(Struct):
    """The state of the link, which only `apply` changes, and its counts of good and bad lines."""

    state: LinkState = "down"
    sparse_s: float = 0.0  # between the last two good lines, after `SPARSE_SILENCES`; else 0
    silences: int = 0
    good_in_row: int = 0
    bad_in_row: int = 0
    heard_ns: Ns | None = None
    silent_ns: Ns = NEVER_HEARD  # later, the link is silent
    waits_until_ns: Ns = 0  # the board may answer late until then
    waited: bool = False  # `wait` was called since the last good line

    def apply(self, trigger: Input) -> None:
        """Change the state by `TRANSITIONS`; only "trusted" keeps the good lines in a row."""
        self.state = TRANSITIONS.get((self.state, trigger), self.state)
        if trigger == "trusted":
            return
        self.good_in_row = 0
        if trigger in ("closed", "opened", "restarted"):
            self.heard_ns, self.silent_ns = None, NEVER_HEARD
        if trigger in ("closed", "opened"):
            self.bad_in_row = 0
            self.reset_silences()

    def silent(self, now_ns: Ns) -> bool:
        """Return whether the last good line of this session is older than `quiet_ns`, or missing.

        The result is False during the time that `wait` adds.
        """
        return now_ns > self.silent_ns

    def good(self, at_ns: Ns, quiet_ns: Ns) -> int | None:
        """Count a good line, and return the time since the previous one, None for the first one."""
        since_ns = None if self.heard_ns is None else at_ns - self.heard_ns
        if at_ns <= self.silent_ns:
            if self.silences:
                self.reset_silences()
        else:
            self.reset_good_lines()
            if since_ns is not None:
                self.silences += 1
                self.sparse_s = since_ns / NS_PER_S if self.silences >= SPARSE_SILENCES else 0.0
        self.good_in_row += 1
        self.bad_in_row = 0
        self.heard_ns, self.waited = at_ns, False
        self.silent_ns = max(at_ns + quiet_ns, self.waits_until_ns)
        return since_ns

    def wait(self, now_ns: Ns, quiet_ns: Ns) -> None:
        """Give the board a third of `quiet_ns` more, because it may have had no line to answer.

        This works once after each good line while the link is up, so without a good line the link
        is stale after `quiet_ns`, the time without sent lines, and `quiet_ns` / 3.
        """
        if self.state == "up" and not self.waited:
            self.waited = True
            self.waits_until_ns = now_ns + quiet_ns // 3
            self.silent_ns = max(self.silent_ns, self.waits_until_ns)

    def reset_silences(self) -> None:
        """Reset the silences in a row: a line came in time, or the board is not the cause."""
        self.silences, self.sparse_s = 0, 0.0

    def reset_good_lines(self) -> None:
        """Reset the count of good lines in a row, unless the link is up."""
        if self.state != "up":
            self.good_in_row = 0

    def bad(self, checked: bool) -> None:
        """Count a bad line; enough of them make a checked link stale."""
        self.reset_good_lines()
        self.bad_in_row += 1
        if checked and self.bad_in_row == BAD_LINES:
            self.apply("damaged")

    @property
    def damaged(self) -> bool:
        """Whether at least the last `BAD_LINES` lines were bad."""
        return self.bad_in_row >= BAD_LINES

    def decide_state(self, now_ns: Ns, may_rise: bool, checked: bool) -> None:
        """Change the state to "stale" after a silence, or, if it may rise, to "up"."""
        silent = self.silent(now_ns)
        if self.state == "up":
            if silent:
                self.apply("silent")
        elif (
            may_rise
            and not silent
            and self.good_in_row >= (CHECKED_LINES if checked else GOOD_LINES)
        ):
            self.apply("trusted")
