"""Explains the link to the operator: why it is not up, or loses lines, and what to do.

The module knows three causes of a silence: this computer did not run (`Lateness`), the board sent
something else (`SilenceDiagnosis`), or the board is silent. It also warns if a link that is up
loses answers (`UnansweredLines`), and it has the sentences for `state.reason`, the log and the web
page. It decides nothing about the link itself, which `link_state.py` judges by the silence alone.
`acsard mcu check` shares the diagnosis.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.core.formatting import many, printable_bytes
from acsard.core.link.codec import TOKENS
from acsard.core.link.link_state import WORDS, Link
from acsard.core.link.link_state import State as LinkState
from acsard.core.link.negotiation import MENDS, Negotiation
from acsard.core.values import NS_PER_S, Event

SHARE = 0.5
"""Share of the silence that ends a link. Two steps this far apart have caused the silence."""

BUSY = "which other program uses the processor? (`top` shows it; as a service acsard has priority)"
"""The advice for a computer that is late."""

HOST = "this computer did not run for"
SIMULATOR = "the built-in simulator, which is a part of this program, is late"

PATIENCE_NS = 3 * NS_PER_S
"""Time before the first diagnosis. A board that boots has answered by then."""

SHOWN = 64
"""Most characters that are shown: a whole line and some noise on it."""

Look = Literal["nothing", "statuses", "cut", "foreign", "garbage", "few", "sparse"]
"""The look of the received bytes.

- nothing: no byte at all
- statuses: status lines of the board, and no reply
- cut: pieces of valid lines, or lines without an end
- foreign: valid lines with other bytes on them
- garbage: nothing that resembles a line
- few: good lines among others
- sparse: only good lines, but too seldom
"""

LOOK_MENDS: dict[Look, str] = {
    "nothing": "has the board power, is this its port, does mcu.baud_rate fit, are TX and RX "
    "swapped?",
    "statuses": "does the line from this computer (TX) reach the board's RX?",
    "cut": "does the board cut its lines short, or omit the line ends?",
    "foreign": "does something disturb the cable, or print on it too?",
    "garbage": "does mcu.baud_rate fit the board?",
    "few": "check cable, ground and baud rate",
    "sparse": "if the board sends its lines less often than the daemon, set mcu.reply_period",
}

_RIGHT = re.compile(TOKENS)
_PIECE = re.compile(rb"[abcdpn0-9A-F., #@*\r\n]+")
"""All characters that a reply can contain."""

BLOCKED = (
    "the serial port sends nothing, because its driver accepts no bytes: unplug the "
    "adapter and plug it in again"
)
"""The reason while the driver takes no bytes."""

WINDOW = 1000
"""Lines sent that are examined together: 10 s at 100 Hz."""

LOST = 0.02
"""Share of lost answers that causes the warning. A sound link loses none."""


def is_ours(words: str) -> bool:
    """Return whether `Lateness.words` blames this computer for the silence."""
    return HOST in words or SIMULATOR in words


class Lateness:
    """The lateness of the control steps."""

    def __init__(self, simulated: bool, quiet_ns: int) -> None:
        """Start.

        Args:
            simulated: Whether the board is a part of this process.
            quiet_ns: The duration of silence that ends a link, ns.
        """
        self._simulated, self._least_ns = simulated, SHARE * quiet_ns
        self._looked_ns: int | None = None
        self.late_s = 0.0
        """Longest time without a step since the last good line, s; 0 if no step was late."""
        self.step_s = 0.0
        """Time between the last two steps if it was too long, else 0; s."""

    def look(self, now_ns: int, good: bool) -> bool:
        """Note a step, and whether a good line came with it.

        Return True if this line ends a silence that this computer caused.
        """
        before_ns, self._looked_ns = self._looked_ns, now_ns
        passed_ns = 0 if before_ns is None else now_ns - before_ns
        self.step_s = passed_ns / NS_PER_S if passed_ns >= self._least_ns else 0.0
        late_s = max(self.late_s, self.step_s)
        self.late_s = 0.0 if good else late_s
        return good and (late_s > 0.0 or self._simulated)

    def words(self, link: LinkState) -> str:
        """Return a sentence about the link."""
        if link == "stale" and self.late_s:
            return (
                f"{HOST} {self.late_s:.2f} s, and received nothing from the microcontroller: {BUSY}"
            )
        if link == "stale" and self._simulated:
            return f"{SIMULATOR}: {BUSY}"
        return WORDS[link]


class Heard(Struct):
    """The bytes and lines received in an interval.

    `last` is the last line, or bytes, that was bad.
    """

    size: int = 0
    """Number of bytes."""
    lines: int = 0
    good: int = 0
    statuses: int = 0
    """Number of the board's status lines, which are not counted in `lines`."""
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
        if self.statuses and not self.lines:
            return "statuses"
        if not self.size:
            return "nothing"
        if self.good:
            return "few" if self.good < self.lines else "sparse"
        if self.lines and _RIGHT.search(self.last):
            return "foreign"
        return "cut" if _PIECE.fullmatch(self.last) else "garbage"

    @property
    def counted(self) -> str:
        """Text with the number of received lines and the last bad line; bytes if no line ended."""
        if self.statuses and not self.lines:
            return "only status lines were received"
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
        mend = f"{LOOK_MENDS[self.looks]} `acsard mcu check` finds out more"
        return f"the microcontroller: {self.counted}; {mend}"


class SilenceDiagnosis:
    """Diagnoses, in intervals of `PATIENCE_NS`, why the link is not up."""

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


class UnansweredLines:
    """Warns if the board leaves lines of an established link unanswered; nothing else shows that.

    The totals of lines sent and of good lines are compared window by window. The warning comes
    once, until the link is sound again or lost. A board that reports by its own clock at another
    rate looks the same and is not faulty.
    """

    def __init__(self, reply_period: float) -> None:
        """Start; `reply_period` is that of a board with a clock of its own, s, else 0."""
        self._own_clock = reply_period > 0.0
        self._since: tuple[int, int] | None = None
        self._told = False

    def look(self, sent: int, good: int, linked: bool) -> Event | None:
        """Take the present totals; return the warning, if one is due."""
        if not linked or self._own_clock:
            self._since, self._told = None, False
            return None
        if self._since is None:
            self._since = sent, good
        lines, answers = sent - self._since[0], good - self._since[1]
        if lines < WINDOW:
            return None
        self._since = sent, good
        told, self._told = self._told, answers < (1.0 - LOST) * lines
        if told or not self._told:
            return None
        return Event(
            "lines_lost",
            f"only {answers} of {lines} lines were answered: the others are lost on the way "
            "there or back, or the microcontroller reports by its own clock; `acsard mcu check` "
            "finds out which",
            "warning",
        )


def damaged(link: Link, check: Negotiation) -> bool:
    """Return whether the daemon asks for the checked link because replies were damaged."""
    return link.damaged and check.asking


def words(
    link: Link,
    check: Negotiation,
    hearing: SilenceDiagnosis,
    lateness: Lateness,
    longest_reply: float,
) -> str:
    """Return a sentence about the link of an open port.

    `longest_reply` is the largest value of mcu.reply_period, s.
    """
    if link.state in ("booting", "stale"):
        heard = hearing.heard
        if check.trouble:
            return MENDS[check.trouble]
        if heard is not None and not heard.good:
            return heard.words
        if damaged(link, check):
            return (
                "the microcontroller's replies arrive damaged; the daemon asks it for the "
                "check again"
            )
        if link.sparse_s:
            return _sparse(link.sparse_s, longest_reply)
        if heard is not None:
            return heard.words
    return lateness.words(link.state)


def _sparse(sparse_s: float, longest_reply: float) -> str:
    apart = f"{sparse_s:.2f}"
    told = f"the microcontroller's lines come {apart} s apart"
    if float(apart) > longest_reply:
        return (
            f"{told}, which is too seldom for any setting; firmware that reports by its own "
            f"clock must send a line at least every {longest_reply:g} s"
        )
    return f"{told}; if it reports by its own clock, set mcu.reply_period = {apart}"


def check_event(check: Negotiation, wants_samples: bool) -> Event:
    """Return the event for a newly agreed line form, a warning if the board lacks part of it."""
    fallen = check.state == "plain" or (wants_samples and check.state == "checked")
    text = f"the serial lines are {check.in_force}"
    if check.state == "plain":
        text += ": the microcontroller answers without the check"
    elif fallen:
        text += ": the microcontroller sends no counts"
    return Event("link_check", text, "warning" if fallen else "info")
