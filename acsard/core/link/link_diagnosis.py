"""Explains to the operator why the link is not up or why lines are lost, and how to repair it.

The sentences appear in `state.reason`, in the log and on the web page. `acsard mcu check` uses the
same diagnosis. The diagnosis does not change the state of the link, which `link_state.py` decides.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from acsard.core.codes import CODES, LinkCode, Reason, sentence
from acsard.core.formatting import many, printable_bytes
from acsard.core.link.codec import TOKENS
from acsard.core.link.link_state import Link
from acsard.core.link.link_state import State as LinkState
from acsard.core.link.negotiation import TROUBLES, Negotiation
from acsard.core.values import NS_PER_S, Event

LATE_STEP_FRACTION = 0.5
"""Least time between two control steps that makes the second step late, as a share of
`Link.quiet_ns`. `Link.quiet_ns` is the duration of silence after which the link is stale. If a
silence ends with a late step, this computer has caused the silence, because it did not run the
daemon."""

BUSY_ADVICE = CODES["host_late"].advice

STATE_REASONS: dict[LinkState, Reason] = {
    "down": sentence("port_closed"),
    "booting": sentence("booting"),
    "up": sentence("link_up"),
    "stale": sentence("link_silent"),
}
SIMULATOR_FAULT = sentence("simulator_fault")

FIRST_DIAGNOSIS_NS = 3 * NS_PER_S
"""Time without a link until the first diagnosis, ns. A board that is only booting answers within
this time."""

MAX_SHOWN_BYTES = 64
"""Largest number of bytes that a diagnosis shows: enough for a complete line and some noise."""

ReceivedClass = Literal["nothing", "statuses", "cut", "foreign", "garbage", "few", "sparse"]
"""The class of the bytes that the board sent while the link was not up.

- nothing: no byte at all
- statuses: status lines of the board, but no reply
- cut: pieces of valid lines, or lines without a line end
- foreign: valid lines with other bytes before or after them
- garbage: nothing that resembles a line
- few: some good lines, and also bad ones
- sparse: only good lines, but too few of them
"""

RECEIVED_CODES: dict[ReceivedClass, LinkCode] = {
    "nothing": "received_nothing",
    "statuses": "received_statuses",
    "cut": "received_cut",
    "foreign": "received_foreign",
    "garbage": "received_garbage",
    "few": "received_few",
    "sparse": "received_sparse",
}

_RIGHT = re.compile(TOKENS)
_PIECE = re.compile(rb"[abcdpn0-9A-F., #@*\r\n]+")
"""Pattern of bytes that may be a piece of a reply: only characters that a reply can contain."""

PORT_BLOCKED = sentence("port_blocked")

WINDOW_LINES = 1000
"""Number of sent lines after which `UnansweredLines` counts the answers to these lines. At 100 Hz,
this takes 10 s."""

MAX_UNANSWERED_FRACTION = 0.02
"""Share of unanswered lines above which `UnansweredLines` warns. A good link loses no answer."""


class Lateness:
    """Detector of control steps that come too late.

    The daemon reads the lines of the board only in its control steps. So if a silence ends with a
    late step, this computer has caused the silence, and the board is not to blame.
    """

    def __init__(self, simulated: bool, quiet_ns: int) -> None:
        """Create the detector before the first control step.

        `simulated` is true if the built-in simulator takes the place of the board. `quiet_ns` is
        the duration of silence after which the link is stale, ns.
        """
        self._simulated, self._least_ns = simulated, LATE_STEP_FRACTION * quiet_ns
        self._looked_ns: int | None = None
        self.late_s = 0.0
        """Longest time between two control steps since the last good line, s; 0 if no control step
        was late."""
        self.step_s = 0.0
        """Time between the last two control steps, s, if the last step was late; otherwise 0."""

    def record_step(self, now_ns: int, good: bool) -> bool:
        """Record a control step. Return whether this step ends a silence that this computer caused.

        Only a good line from the board ends a silence. The built-in simulator runs on this
        computer, so this computer causes each of the simulator's silences. With the simulator, the
        result is therefore True for every good line, even if no silence came before the line.

        Args:
            now_ns: the monotonic time of the control step, ns.
            good: whether the control step received a good line.
        """
        before_ns, self._looked_ns = self._looked_ns, now_ns
        passed_ns = 0 if before_ns is None else now_ns - before_ns
        step_s = self.step_s = passed_ns / NS_PER_S if passed_ns >= self._least_ns else 0.0
        late_s = step_s if step_s > self.late_s else self.late_s
        self.late_s = 0.0 if good else late_s
        return good and (late_s > 0.0 or self._simulated)

    def describe(self, link: LinkState) -> Reason:
        """Return a sentence that describes the state `link` for the operator.

        If the link is stale because a control step was late, the sentence blames this computer. If
        the link to the built-in simulator is stale, the sentence blames the simulator.
        """
        if link == "stale" and self.late_s:
            received = "nothing from the microcontroller"
            return sentence("host_late", seconds=self.late_s, received=received)
        if link == "stale" and self._simulated:
            return SIMULATOR_FAULT
        return STATE_REASONS[link]


class Heard(Struct):
    """A summary of the bytes and lines that the daemon received in an interval without a link."""

    size: int = 0
    """Number of received bytes, without the bytes of status lines."""
    lines: int = 0
    """Number of received lines, good and bad, without the status lines."""
    good: int = 0
    """Number of good lines."""
    statuses: int = 0
    """Number of the board's status lines."""
    last: bytes = b""
    """The last bad line, or the last received bytes if no line is complete yet."""
    late_s: float = 0.0
    """Longest time in the interval in which this computer did not run the daemon, s."""

    def take(self, data: bytes) -> None:
        """Add received bytes. Call this method before `line` adds the lines in these bytes."""
        self.size += len(data)
        if not self.lines:
            self.last = (self.last + data)[-MAX_SHOWN_BYTES:]

    def line(self, line: bytes, good: bool) -> None:
        """Add a received line without its line end. `good` is true if the line is a valid reply."""
        self.lines += 1
        self.good += good
        if not good:
            self.last = line

    @property
    def looks(self) -> ReceivedClass:
        """The class of the received bytes. `ReceivedClass` explains the classes."""
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
        """The number of received lines and the last bad line (or the last bytes), as text."""
        if self.statuses and not self.lines:
            return "only status lines were received"
        if not self.size:
            return "nothing was received"
        if not self.lines:
            last = printable_bytes(self.last, MAX_SHOWN_BYTES, last=True)
            return (
                f"{many(self.size, 'byte')} received but no line end; the last bytes are `{last}`"
            )
        good, which = "none good", "last one"
        if self.good:
            good, which = f"only {self.good} good", "last bad one"
            if self.good == self.lines:
                good = "all of them good, but too few for a link"
        bad = printable_bytes(self.last, MAX_SHOWN_BYTES)
        last = f", the {which} is `{bad}`" if self.good < self.lines else ""
        return f"{many(self.lines, 'line')} received, {good}{last}"

    @property
    def diagnosis(self) -> Reason:
        """The complete diagnosis as a sentence for the message `state`."""
        if self.looks == "sparse" and self.late_s:
            received = "too few lines for a link"
            return sentence("host_late", seconds=self.late_s, received=received)
        return sentence(RECEIVED_CODES[self.looks], received=self.counted)


class SilenceDiagnosis:
    """The diagnosis of why the link is not up, renewed every 3 s (`FIRST_DIAGNOSIS_NS`)."""

    def __init__(self) -> None:
        self.heard: Heard | None = None
        """The bytes and lines of the last complete interval. None while there is no diagnosis."""
        self.now = Heard()
        """The bytes and lines received in the present interval so far."""
        self._since_ns: int | None = None

    def forget(self) -> None:
        """Discard the diagnosis. The next call of `judge` begins a new interval.

        The caller does this if the link is up, if the output is blocked, or if the port was opened
        or closed.
        """
        self.heard, self.now, self._since_ns = None, Heard(), None

    def judge(self, now_ns: int, late_s: float = 0.0) -> bool:
        """Process a control step without a link, and return whether the diagnosis is new.

        Every 3 s (`FIRST_DIAGNOSIS_NS`), the received bytes give a new diagnosis. The result is
        True for the first diagnosis. It is also True if the class of the received bytes
        (`ReceivedClass`) differs from the class in the previous diagnosis. `late_s` is the time
        since the previous step, s, if this step is late; otherwise 0.
        """
        if self._since_ns is None:
            # The interval begins with this step, so the time before it does not belong to it.
            self._since_ns = now_ns
        else:
            self.now.late_s = max(self.now.late_s, late_s)
        if now_ns - self._since_ns < FIRST_DIAGNOSIS_NS:
            return False
        before, self.heard = self.heard, self.now
        self.now, self._since_ns = Heard(), now_ns
        return before is None or before.looks != self.heard.looks


class UnansweredLines:
    """The warning that the board does not answer all lines while the link is up.

    After every `WINDOW_LINES` sent lines, the class compares the number of sent lines with the
    number of good lines received. If too many answers are missing, the class warns. It does not
    repeat the warning until the board has answered enough of a later series of `WINDOW_LINES`
    lines, or the link was lost.

    A healthy board also causes the warning if it reports by its own clock, sends fewer lines than
    the daemon, and `mcu.reply_period` is not set.
    """

    def __init__(self, reply_period: float) -> None:
        """Start before the first line was sent.

        `reply_period` is the setting `mcu.reply_period`, s. If it is not 0, the board does not
        answer lines but reports by its own clock, so the class never warns.
        """
        self._own_clock = reply_period > 0.0
        self._since: tuple[int, int] | None = None
        self._told = False

    def check(self, sent: int, good: int, linked: bool) -> Event | None:
        """Return the warning if it is due, else None.

        `sent` is the number of lines sent, and `good` the number of good lines received, both since
        the daemon started. `linked` is true if the link is up.
        """
        if not linked or self._own_clock:
            self._since, self._told = None, False
            return None
        if self._since is None:
            self._since = sent, good
        lines, answers = sent - self._since[0], good - self._since[1]
        if lines < WINDOW_LINES:
            return None
        self._since = sent, good
        warned, self._told = self._told, answers < (1.0 - MAX_UNANSWERED_FRACTION) * lines
        if warned or not self._told:
            return None
        return Event(
            "lines_lost",
            f"the microcontroller answered only {answers} of {lines} lines: lines or answers get "
            "lost, or the microcontroller reports by its own clock; `acsard mcu check` finds out "
            "which of these it is",
            "warning",
        )


def damaged(link: Link, check: Negotiation) -> bool:
    """Return whether the daemon asks for checked lines again because replies were damaged."""
    return link.damaged and check.asking


def describe_link(
    link: Link,
    check: Negotiation,
    silence: SilenceDiagnosis,
    lateness: Lateness,
    longest_reply: float,
) -> Reason:
    """Return a sentence for the operator about the state of the link while the port is open.

    `check` is the negotiation of the checksum, `silence` is the diagnosis of a silence, and
    `lateness` is the detector of late control steps. `longest_reply` is the highest value that the
    setting `mcu.reply_period` may have, s.
    """
    if link.state in ("booting", "stale"):
        traffic = silence.heard
        if check.trouble:
            return TROUBLES[check.trouble]
        if traffic is not None and not traffic.good:
            return traffic.diagnosis
        if damaged(link, check):
            return sentence("replies_damaged")
        if link.sparse_s:
            return _sparse(link.sparse_s, longest_reply)
        if traffic is not None:
            return traffic.diagnosis
    return lateness.describe(link.state)


def _sparse(sparse_s: float, longest_reply: float) -> Reason:
    apart = f"{sparse_s:.2f}"
    if float(apart) > longest_reply:
        return sentence("lines_too_rare", apart=apart, longest=longest_reply)
    return sentence("reply_period", apart=apart)


def check_event(check: Negotiation, wants_samples: bool) -> Event:
    """Return the log event that says whether the lines on the wire are now plain or checked.

    A checked line has a checksum. The event is a warning if the board does not support the
    checksum. It is also a warning if `wants_samples` is true and the board does not send its
    encoder counts.
    """
    fallen = check.state == "plain" or (wants_samples and check.state == "checked")
    text = f"the lines on the serial port are now {check.in_force}"
    if check.state == "plain":
        text += ", because the microcontroller answers without a checksum"
    elif fallen:
        text += ", but the microcontroller does not send encoder counts"
    return Event("link_check", text, "warning" if fallen else "info")
