"""Diagnoses a silent link from the bytes that the port received while the link was not up.

The diagnosis is for the operator and decides nothing. The daemon, which shows it in `state` and the
log after `PATIENCE_NS`, shares it with `acsard mcu check`.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.core.formatting import many, printable_bytes
from acsard.core.link.codec import TOKENS
from acsard.core.link.host_stalls import BUSY, HOST
from acsard.core.values import NS_PER_S

PATIENCE_NS = 3 * NS_PER_S
"""Time before the first diagnosis. A board that boots has answered by then."""

SHOWN = 64
"""Most characters that are shown: a whole line and some noise on it."""

Look = Literal["nothing", "cut", "foreign", "garbage", "few", "sparse"]
"""The look of the received bytes.

- nothing: no byte at all
- cut: pieces of valid lines, or lines without an end
- foreign: valid lines with other bytes on them
- garbage: nothing that resembles a line
- few: good lines among others
- sparse: only good lines, but too seldom
"""

MENDS: dict[Look, str] = {
    "nothing": "has the board power, is this its port, does mcu.baud_rate fit, are TX and RX "
    "swapped?",
    "cut": "does the board cut its lines short, or omit the line ends?",
    "foreign": "does something disturb the cable, or print on it too?",
    "garbage": "does mcu.baud_rate fit the board?",
    "few": "check cable, ground and baud rate",
    "sparse": "if the board sends its lines less often than the daemon, set mcu.reply_period",
}

_RIGHT = re.compile(TOKENS)
_PIECE = re.compile(rb"[abcdpn0-9A-F., #@*\r\n]+")
"""All characters that a reply can contain."""


class Heard(Struct):
    """The bytes and lines received in an interval.

    `last` is the last line, or bytes, that was bad.
    """

    size: int = 0
    """Number of bytes."""
    lines: int = 0
    good: int = 0
    last: bytes = b""
    late_s: float = 0.0
    """Longest time in the interval in which this computer did not run and received nothing, s."""

    def take(self, data: bytes) -> None:
        """Take received bytes, before their lines."""
        self.size += len(data)
        if not self.lines:
            self.last = (self.last + data)[-SHOWN:]

    def line(self, line: bytes, good: bool) -> None:
        """Take one line of them without its end."""
        self.lines += 1
        self.good += good
        if not good:
            self.last = line

    @property
    def looks(self) -> Look:
        """The look of the bytes."""
        if not self.size:
            return "nothing"
        if self.good:
            return "few" if self.good < self.lines else "sparse"
        if self.lines and _RIGHT.search(self.last):
            return "foreign"
        return "cut" if _PIECE.fullmatch(self.last) else "garbage"

    @property
    def counted(self) -> str:
        """The number of bytes or lines and the last bad one, as text."""
        if not self.size:
            return "nothing was received"
        if not self.lines:
            last = printable_bytes(self.last, SHOWN, last=True)
            return (
                f"{many(self.size, 'byte')} received but no line end; the last bytes are `{last}`"
            )
        good, which = "none good", "last"
        if self.good:
            good, which = f"only {self.good} good", "last other"
            if self.good == self.lines:
                good = "all of them good, but too few"
        bad = printable_bytes(self.last, SHOWN)
        last = f", the {which} `{bad}`" if self.good < self.lines else ""
        return f"{many(self.lines, 'line')} received, {good}{last}"

    @property
    def words(self) -> str:
        """The whole diagnosis as a sentence for `state`."""
        if self.looks == "sparse" and self.late_s:
            return f"{HOST} {self.late_s:.2f} s, and received too little for a link: {BUSY}"
        mend = f"{MENDS[self.looks]} `acsard mcu check` finds out more"
        return f"the microcontroller: {self.counted}; {mend}"


class SilenceDiagnosis:
    """The diagnosis while the link is not up; `heard` is its last complete interval."""

    def __init__(self) -> None:
        self.heard: Heard | None = None
        """The last interval of `PATIENCE_NS`; None before the first one ends, and while the link is
        up."""
        self.now = Heard()
        """The interval under way."""
        self._since_ns: int | None = None

    def forget(self) -> None:
        """Start over: the link is up, or the port has been opened again."""
        if self._since_ns is not None:
            self.heard, self.now, self._since_ns = None, Heard(), None

    def judge(self, now_ns: int) -> bool:
        """Note that the link is still not up. Return whether the diagnosis has changed."""
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < PATIENCE_NS:
            return False
        before, self.heard = self.heard, self.now
        self.now, self._since_ns = Heard(), now_ns
        return before is None or before.looks != self.heard.looks
