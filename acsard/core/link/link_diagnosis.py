"""Explains to the operator why the link is not up or why lines are lost, and how to repair it.

The sentences appear in `state.reason`, in the log and on the web page. `acsard mcu check` uses the
same diagnosis. The diagnosis does not change the state of the link, which `link_state.py` decides.
"""

from __future__ import annotations

import re

from msgspec import Struct, field
from msgspec.structs import replace

from acsard.core.codes import CODES, Reason, joined, reason, sentence
from acsard.core.formatting import many, printable_bytes
from acsard.core.link.board_status import IDENTITY
from acsard.core.link.codec import SPEED
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import Link, LinkState
from acsard.core.link.step_times import StepTimes
from acsard.core.tables.link_codes import ReceivedCode
from acsard.core.values import NS_PER_S, TWO_WHEELS, WHEELS, Event, Ns, wheel_names

BUSY_ADVICE = CODES["host_late"].advice

STATE_REASONS: dict[LinkState, Reason] = {
    "down": sentence("port_closed"),
    "booting": sentence("booting"),
    "up": sentence("link_up"),
    "stale": sentence("link_silent"),
}
SIMULATOR_FAULT = sentence("simulator_fault")

FIRST_DIAGNOSIS_NS = 3 * NS_PER_S  # a board that is only booting answers within this time

MAX_SHOWN_BYTES = 64  # a complete line and some noise

# Text that names its sender, or what happened to it. Noise does not make it.
_NAMED: dict[ReceivedCode, re.Pattern[bytes]] = {
    "received_brownout": re.compile(rb"Brownout detector|BROWN_?OUT"),
    "received_boot": re.compile(rb"rst:0x[0-9a-f]|ESP-ROM:|^ets [A-Z][a-z]{2} "),
    "received_nmea": re.compile(rb"^\$[A-Z]{5},.*\*[0-9A-F]{2}$"),
}

FIND_OUT_MORE = "; `acsard mcu check` finds out more"

CHECKED_FIRMWARE = ', does its firmware support mcu.link_check = "on" (else write "off")'

# Of any motors: which ones a robot has is declared.
_LETTER = rb"[a-moq-z]"
_PAIR = _LETTER + rb"[pn]" + SPEED + rb", *" + _LETTER + rb"[pn]" + SPEED
_RIGHT = {2: re.compile(_PAIR), 4: re.compile(_PAIR + rb", *" + _PAIR)}  # by the number of motors
_WHOLE = re.compile(rb"(%b(?:, *%b)?)(?:, *)?(?:#[0-9A-F@*]*)?" % (_PAIR, _PAIR))
_MOTOR = re.compile(rb"([a-z])[pn]")
# By the number of motors. Each byte has one place in it, so that no line makes the search for a
# match long.
_OTHER_FORMS = {
    motors: re.compile(
        (_LETTER + rb"[: =]*(?:[pn+-] *)?(?:[0-9]+(?:\.[0-9]+)?|\.[0-9]+)[,; \t]*") * motors,
        re.IGNORECASE,
    )
    for motors in (2, 4)
}
_WORD = re.compile(rb"[A-Za-z]{3}")
_VALUE = re.compile(rb"(?<![A-Za-z])" + _LETTER + rb"[pn] *[0-9]+\.[0-9]")
# Only characters that a reply can contain.
_PIECE = re.compile(rb"[a-z0-9A-F., #@*\r\n]+")


def is_text(line: bytes) -> bool:
    """Return whether a bad line is text that the firmware prints, and no damaged reply.

    Noise leaves some values of a reply whole, and makes bytes that cannot be printed.
    """
    return (
        line.isascii()
        and line.decode().isprintable()
        and bool(_WORD.search(line) and not _VALUE.search(line))
    )


def named(line: bytes) -> ReceivedCode | None:
    """Return what a bad line says of its sender, if it says anything."""
    return next((code for code, text in _NAMED.items() if text.search(line)), None)


PORT_BLOCKED = sentence("port_blocked")

WINDOW_LINES = 1000  # sent lines whose answers are counted: 10 s at 100 Hz

MAX_UNANSWERED_FRACTION = 0.02  # a good link loses no answer


class Traffic(Struct):
    """The bytes and lines that the daemon received in an interval without a link."""

    size: int = 0  # bytes, without status lines
    lines: int = 0  # good and bad, without status lines
    good: int = 0
    statuses: int = 0
    texts: int = 0  # bad lines for which `is_text` holds
    identified: bool = False  # acsard's firmware has named itself, here or in an interval before
    named: ReceivedCode | None = None  # by bad lines; that of a low supply stays
    formed: int = 0  # bad lines that are replies in another form
    lettered: int = 0  # bad lines that are replies of other motors
    motors: str = ""  # letters of the last such line, sorted
    last: bytes = b""  # last bad line, or incomplete bytes
    within: bool = False  # the last bad line contains the values of all motors
    late_s: float = 0.0  # longest time in which this computer did not run the daemon

    def take(self, data: bytes) -> None:
        """Add received bytes, before `line` adds the lines in them."""
        self.size += len(data)
        if not self.lines:
            self.last = (self.last + data)[-MAX_SHOWN_BYTES:]

    def line(self, line: bytes, good: bool, letters: str) -> None:
        """Add a line without its end; `good` if it is a valid reply of the motors `letters`."""
        self.lines += 1
        self.good += good
        if not good:
            self.last, self.within = line, bool(_RIGHT[len(letters)].search(line))
            self.identified = self.identified or line.startswith(IDENTITY)
            self.texts += is_text(line)
            if self.named != "received_brownout":
                self.named = named(line) or self.named
            if whole := _WHOLE.fullmatch(line):
                motors = b"".join(sorted(_MOTOR.findall(whole[1]))).decode()
                if motors != letters:
                    self.lettered, self.motors = self.lettered + 1, motors
            elif _OTHER_FORMS[len(letters)].fullmatch(line):
                self.formed += 1

    @property
    def code(self) -> ReceivedCode:
        if self.named:
            return self.named
        if self.identified and not (self.good or self.formed or self.lettered):
            return "received_identity"
        if self.statuses and not self.lines:
            return "received_statuses"
        if not self.size:
            return "received_nothing"
        bad = self.lines - self.good
        if 2 * self.texts > bad:
            return "received_text"
        if 2 * self.formed > bad:
            return "received_form"
        if 2 * self.lettered > bad:
            return "received_letters"
        if self.good:
            return "received_few" if bad else "received_sparse"
        if self.within:
            return "received_foreign"
        return "received_cut" if _PIECE.fullmatch(self.last) else "received_garbage"

    @property
    def counted(self) -> str:
        """The number of lines, and the last bad one or the last bytes, as text."""
        if self.identified and not self.lines:
            return "only its name was received"
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
    def wheels(self) -> str:
        """What to do about a board that names other motors than the configuration, as text."""
        motors = self.motors
        if not motors:
            return ""
        if len({*motors}) < len(motors):
            return "the firmware must name each motor once"
        # Motor a is on the right, as the sketch and the wiring have it, but l and r name a side.
        names = wheel_names(len(motors))
        if {*motors} == {"l", "r"}:
            names = names[::-1]
        entries = [f'{name} = "+{motor}"' for name, motor in zip(names, motors, strict=False)]
        if names == WHEELS:
            entries += [f'{name} = ""' for name in TWO_WHEELS]
        return f"write {', '.join(entries)} into [mcu.wheels]"

    def diagnosis(self, checked: bool = False) -> Reason:
        """Return the complete diagnosis, for `state`; `checked` is `mcu.checked`."""
        if self.code == "received_sparse" and self.late_s:
            received = "too few lines for a link"
            return sentence("host_late", seconds=self.late_s, received=received)
        why = joined(self.reason(firmware=CHECKED_FIRMWARE if checked else ""))
        return why if self.named else replace(why, text=f"{why.text}{FIND_OUT_MORE}")

    def reason(self, where: str = "{}", firmware: str = "") -> Reason:
        """Return what the bytes show, and what to do; `where` says more about the bytes."""
        received = where.format(self.counted)
        return reason(self.code, received=received, firmware=firmware, wheels=self.wheels)


class SilenceDiagnosis(Struct):
    """The diagnosis of why the link is not up, renewed every `FIRST_DIAGNOSIS_NS`."""

    complete: Traffic | None = None  # of the last complete interval, if there is a diagnosis
    now: Traffic = field(default_factory=Traffic)  # of the present interval
    since_ns: Ns | None = None

    def forget(self) -> None:
        """Discard the diagnosis: the link is up, the output blocked, or the port changed."""
        self.complete, self.now, self.since_ns = None, Traffic(), None

    def diagnose(self, now_ns: Ns, late_s: float = 0.0) -> bool:
        """Process a step without a link, and return whether the diagnosis is of a new class."""
        if self.since_ns is None:
            self.since_ns = now_ns
        else:
            self.now.late_s = max(self.now.late_s, late_s)
        if now_ns - self.since_ns < FIRST_DIAGNOSIS_NS:
            return False
        before, self.complete = self.complete, self.now
        self.now, self.since_ns = Traffic(identified=self.complete.identified), now_ns
        return before is None or before.code != self.complete.code


class UnansweredLines(Struct):
    """Warns that the board does not answer all lines while the link is up.

    After every `WINDOW_LINES`, the lines sent and received are compared. A warning is repeated only
    after enough answers, or a lost link. A healthy board with its own clock and fewer lines causes
    it, too, without `mcu.reply_period`.
    """

    since: tuple[int, int] | None = None  # lines sent and received at the last comparison
    due_lines: int = 0  # lines sent at the next one
    told: bool = False

    def check(self, sent: int, good: int, linked: bool, reply_period: float) -> Event | None:
        """Return the warning if it is due; `sent` and `good` lines are since the start.

        A board with a `reply_period` answers no line, so none is missing.
        """
        if not linked or reply_period:
            self.since, self.due_lines, self.told = None, 0, False
            return None
        if self.since is None:
            self.since, self.due_lines = (sent, good), sent + WINDOW_LINES
        lines, answers = sent - self.since[0], good - self.since[1]
        if lines < WINDOW_LINES:
            return None
        self.since, self.due_lines = (sent, good), sent + WINDOW_LINES
        warned, self.told = self.told, answers < (1.0 - MAX_UNANSWERED_FRACTION) * lines
        if warned or not self.told:
            return None
        return Event(
            "lines_lost",
            f"the microcontroller answered only {answers} of {lines} lines: lines or answers get "
            "lost, or the microcontroller reports by its own clock; `acsard mcu check` finds out "
            "which of these it is",
            "warning",
        )


def describe_link(
    setup: LinkSetup, link: Link, silence: SilenceDiagnosis, steps: StepTimes
) -> Reason:
    """Return a sentence about the link while the port is open."""
    checked = setup.checked
    if link.state in ("booting", "stale"):
        traffic = silence.complete
        if traffic is not None and not traffic.good:
            return traffic.diagnosis(checked)
        if checked and link.damaged:
            return sentence("replies_damaged")
        if link.sparse_s:
            return _sparse(link.sparse_s, setup.longest_reply)
        if traffic is not None:
            return traffic.diagnosis(checked)
    return describe_state(setup, link.state, steps)


def describe_state(setup: LinkSetup, link: LinkState, steps: StepTimes) -> Reason:
    """Return a sentence about the state of the link, which may blame this computer."""
    if link == "stale" and steps.late_s:
        received = "nothing from the microcontroller"
        return sentence("host_late", seconds=steps.late_s, received=received)
    if link == "stale" and setup.mcu.simulated:
        return SIMULATOR_FAULT
    return STATE_REASONS[link]


def _sparse(sparse_s: float, longest_reply: float) -> Reason:
    interval = f"{sparse_s:.2f}"
    if float(interval) > longest_reply:
        return sentence("lines_too_rare", interval=interval, longest=longest_reply)
    return sentence("reply_period", interval=interval)
