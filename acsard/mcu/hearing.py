"""What came from the microcontroller while the link carried nothing, and what that looks like.

For the person who has to find out why: decides nothing. Shared by the daemon, whose `state` and log
say it after `PATIENCE_NS`, and by `acsard mcu check`.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.mcu.codec import TOKENS
from acsard.mcu.whose_silence import BUSY, HOST
from acsard.values import NS_PER_S

PATIENCE_NS = 3 * NS_PER_S
"""A board that boots has answered by then."""

SHOWN = 64
"""Characters of them that people are shown: a whole line, and noise on it."""

Look = Literal["nothing", "cut", "foreign", "garbage", "few", "sparse"]
"""No byte at all; pieces of right lines, or lines without an end; right lines with other bytes on
them; nothing that looks like a line; good lines among others; good lines only, but too
seldom."""

MENDS: dict[Look, str] = {
    "nothing": "is it powered, is this its port and mcu.baud_rate its own, are TX and RX crossed?",
    "cut": "does it cut its lines short, or leave out their ends?",
    "foreign": "what disturbs the cable, or prints on it too?",
    "garbage": "is mcu.baud_rate the board's own?",
    "few": "look at cable, ground and baud rate",
    "sparse": "if its lines are further apart than ours, say so by mcu.reply_period",
}

_RIGHT = re.compile(TOKENS)
_PIECE = re.compile(rb"[abcdpn0-9A-F., #@*\r\n]+")
"""All that a reply is written with."""


class Heard(Struct):
    """What was heard within some time; `last` are the last bytes that were no good line."""

    size: int = 0
    """Bytes."""
    lines: int = 0
    good: int = 0
    last: bytes = b""
    late_s: float = 0.0
    """This computer did not run for so long within that time, and heard nothing then."""

    def take(self, data: bytes) -> None:
        """Bytes as they came, before their lines."""
        self.size += len(data)
        if not self.lines:
            self.last = (self.last + data)[-SHOWN:]

    def line(self, line: bytes, good: bool) -> None:
        """One line of them without its end."""
        self.lines += 1
        self.good += good
        if not good:
            self.last = line

    @property
    def looks(self) -> Look:
        """What it looks like."""
        if not self.size:
            return "nothing"
        if self.good:
            return "few" if self.good < self.lines else "sparse"
        if self.lines and _RIGHT.search(self.last):
            return "foreign"
        return "cut" if _PIECE.fullmatch(self.last) else "garbage"

    @property
    def counted(self) -> str:
        """How much it was, and the last of it."""
        if not self.size:
            return "nothing at all heard"
        if not self.lines:
            last = printable(self.last, last=True)
            return f"{self.size} bytes heard but no line end, the last `{last}`"
        good, which = "none good", "last"
        if self.good:
            good, which = f"only {self.good} good", "last other"
            if self.good == self.lines:
                good = "all good, but too few"
        last = f", the {which} `{printable(self.last)}`" if self.good < self.lines else ""
        return f"{self.lines} lines heard, {good}{last}"

    @property
    def words(self) -> str:
        """All of it, for `state`."""
        if self.looks == "sparse" and self.late_s:
            return f"{HOST} {self.late_s:.2f} s, and heard too little for a link: {BUSY}"
        mend = f"{MENDS[self.looks]} `acsard mcu check` looks closer"
        return f"the microcontroller: {self.counted}; {mend}"


def printable(data: bytes, last: bool = False) -> str:
    """Bytes for people: the first of them, or the last, what cannot be printed as `\\x00`."""
    shown = [repr(bytes([byte]))[2:-1] for byte in (reversed(data) if last else data)]
    room = 0
    for count, text in enumerate(shown):
        room += len(text)
        if room > SHOWN:
            kept = shown[:count]
            return "…" + "".join(reversed(kept)) if last else "".join(kept) + "…"
    return "".join(reversed(shown) if last else shown)


class Hearing:
    """Listens while the link is not up; `heard` is what it said of the time before now."""

    def __init__(self) -> None:
        self.heard: Heard | None = None
        """Of the last `PATIENCE_NS` that were waited for; None before that, and when linked."""
        self.now = Heard()
        """What comes now."""
        self._since_ns: int | None = None

    def forget(self) -> None:
        """The link is up, or the port has been opened anew."""
        if self._since_ns is not None:
            self.heard, self.now, self._since_ns = None, Heard(), None

    def judge(self, now_ns: int) -> bool:
        """The link is still not up; True when what is heard looks other than it was told."""
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < PATIENCE_NS:
            return False
        before, self.heard = self.heard, self.now
        self.now, self._since_ns = Heard(), now_ns
        return before is None or before.looks != self.heard.looks
