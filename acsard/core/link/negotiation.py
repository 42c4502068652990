"""Negotiates the check of the serial line, with stops only, at every opening and after every gap.

- off: mcu.link_check is "off". Lines are plain and the daemon asks for nothing.
- waking: only stops leave. The board has not answered yet. Every second question is a plain stop,
  because the board may know no other line, and its silence proves nothing.
- asking: only stops leave. The board has answered, so its silence to a question is an answer.
- plain: with "auto" only. The board answers, but without the check. The daemon asks again after the
  next gap.
- checked: a correct reply to a line has come. From now on only correct replies count.
- sampled: checked, and the replies bring the encoder counts that the lines ask for.

A board that has once answered with the check is not believed without it until the port is reopened,
because noise must not end the check.

The module also recognizes lines that only come back, because TX and RX are joined or the far end
echoes. A question that comes back shows it at once, because no reply carries the letters of a
question. For plain lines, and for checked lines that ask for no sample, `EchoDetector` shows it.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from acsard.core.config.settings import McuConfig
from acsard.core.config.wire_time import line_bytes, wire_ns
from acsard.core.link.checksum import ASK_NOTHING, ASK_SAMPLE, SEQUENCES, Checked, seal
from acsard.core.link.codec import FrameError
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.values import NS_PER_S, WheelSpeeds

State = Literal["off", "waking", "asking", "plain", "checked", "sampled"]
Sign = Literal["gap", "heard", "answer", "sample", "refusal", "samples_end"]
"""The inputs of the state machine.

- gap: the link starts over
- heard: a plain line came while asking
- answer: a correct answer to a question, without a sample
- sample: a correct answer to a question, with a sample
- refusal: no question was answered
- samples_end: the replies bring no more samples
"""

TABLE: dict[tuple[State, Sign], State] = {
    ("waking", "gap"): "waking",
    ("waking", "heard"): "asking",
    ("waking", "answer"): "checked",
    ("waking", "sample"): "sampled",
    ("asking", "gap"): "waking",
    ("asking", "answer"): "checked",
    ("asking", "sample"): "sampled",
    ("asking", "refusal"): "plain",
    ("plain", "gap"): "waking",
    ("checked", "gap"): "waking",
    ("sampled", "gap"): "waking",
    ("sampled", "samples_end"): "checked",
}
"""Maps (state, sign) to the next state. Without an entry the state stays."""

IN_FORCE: dict[State, str] = {
    "off": "plain",
    "waking": "being asked for",
    "asking": "being asked for",
    "plain": "plain",
    "checked": "checked",
    "sampled": "checked with samples",
}

Trouble = Literal["", "echo", "forgotten", "unknown"]
"""The reason why asking never ends, so that nothing drives.

- echo: the lines that the daemon sends come back
- forgotten: the board answered with the check before and does not now
- unknown: the board does not know the check, and the configuration requires it
"""

MENDS: dict[Trouble, str] = {
    "": "",
    "echo": "the daemon's own lines come back: TX and RX are connected to each other, or a "
    "terminal or the RS-485 adapter echoes, or the board reports the commanded speeds "
    "instead of the measured ones; fix that, then unplug the board and plug it in again",
    "forgotten": "the microcontroller answered with a check before and now answers without: "
    "either its replies are damaged (check cable and baud rate), or it runs other "
    "firmware (then unplug it and plug it in again)",
    "unknown": 'the microcontroller answers without a check, but mcu.link_check = "require" '
    "lets the robot drive only with one: install firmware that has the check, or "
    'write mcu.link_check = "auto"',
}

TRIES = 3
"""Unanswered questions of a kind after which the board does not know that kind."""

WINDOW = 64
"""Lines whose answers may still come, far fewer than the sequence can distinguish."""

LATE_NS = round(WATCHDOG_S * NS_PER_S)
"""Largest delay of an answer. Before a later one the board's own watchdog has stopped the
motors."""

BLIND_PERIOD_NS = NS_PER_S // 10
"""Distance of the stop lines while nothing comes back: 10 Hz is enough to wake the board and leaves
little in a queue."""

THINKING_NS = 30_000_000
"""Time that the board and the drivers may take to answer besides the wire time."""

FEW_SAMPLES = 5
"""Correct replies in a row without the requested sample, after which samples no longer come."""

REPORTS = 20
"""Equal reports in a row: 0.2 s at 100 Hz."""

CHANGE = 2.0
"""rad/s; sum of the changes among them, of the wheel that changes most. A small one alone may be a
coincidence of coarse encoders."""

LINES = 8
"""Lines that a report is compared with: an echo that comes back within 70 ms at 100 Hz is found."""

_Run = tuple[int, float, WheelSpeeds]
"""The equal reports in a row, the sum of their changes, and the speeds of the last one."""


class Throttle:
    """A limiter that passes one event and the next only after a given time."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        """Monotonic time of the last event that passed, None before the first."""
        self._before_ns: int | None = None

    def lets(self, now_ns: int, wait_ns: int) -> bool:
        """Return whether an event may pass now, `wait_ns` after the last.

        If so it becomes the last.
        """
        if self.last_ns is not None and now_ns - self.last_ns < wait_ns:
            return False
        self._before_ns, self.last_ns = self.last_ns, now_ns
        return True

    def undo(self) -> None:
        """Forget the last event, because its line did not leave. The next line need not wait."""
        self.last_ns = self._before_ns


class EchoDetector:
    """Recognizes a run of reports that only repeat sent lines.

    A reply without a sample has the same form as a command, so an echo looks like a board that
    reports exactly the speeds it was sent. An echo is a run of `REPORTS` reports, each equal byte
    for byte to one of the last `LINES` lines, always the same number of lines before. The changes
    of speed in the run add up to `CHANGE`. At rest every board looks like an echo, and nothing is
    decided.

    A board that measures is not taken for an echo, because its wheels lag behind the lines in
    another way than by a whole number of lines. In simulated drives with accelerations of 0.1 to
    100 m/s2 and encoders of up to 1,000,000 counts a turn, equal reports in a row covered at most
    0.04 rad/s of changes if the motors lag by 2 ms or more. A board that reports its set points,
    or a simulator whose wheels have no lag at all, looks exactly like an echo. The daemon then
    drives nothing until the port is opened again, and says why.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start over: the port has been opened."""
        self._sent: deque[bytes] = deque(maxlen=LINES)
        """The last lines, of which the newest has the number `_lines`."""
        self._lines = self._reports = 0
        self._runs: dict[int, _Run] = {}
        """By the number of a report minus that of its line, which no delay of an echo changes."""

    def left(self, line: bytes) -> None:
        """Note that this line left, with its end."""
        self._lines += 1
        self._sent.append(line.removesuffix(b"\r\n"))

    def report(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Take a report without its end, and the speeds in it; return whether it is an echo."""
        self._reports += 1
        runs: dict[int, _Run] = {}
        if line not in self._sent:
            self._runs = runs
            return False
        first, found = (0, 0.0, speeds), False
        for number, sent in enumerate(self._sent, self._lines - len(self._sent) + 1):
            if line == sent:
                offset = self._reports - number
                equal, change, before = self._runs.get(offset, first)
                if before != speeds:
                    pairs = zip(before.as_tuple(), speeds.as_tuple(), strict=True)
                    change += max([abs(now - then) for then, now in pairs])
                runs[offset] = equal + 1, change, speeds
                found = found or (equal + 1 >= REPORTS and change >= CHANGE)
        self._runs = runs
        return found


class Negotiation:
    """The negotiation of the check. It asks, seals lines, and matches replies with lines."""

    def __init__(self, mcu: McuConfig, stop: bytes) -> None:
        """Start; `stop` is the plain stop line."""
        self._stop, self._wanted = stop, mcu.link_check
        self.state: State = "off" if mcu.link_check == "off" else "waking"
        self.trouble: Trouble = ""
        self.settled_ns = 0
        """Monotonic time at which asking last ended."""
        first = (ASK_SAMPLE,) * TRIES if mcu.wants_samples else (ASK_NOTHING,)
        self._letters = (*first, *(b"",) * TRIES)
        self._question = b""
        """The last question if its echo can be distinguished from an answer, else b""."""
        longest = line_bytes(mcu.trailing_comma, check=True, sample=mcu.wants_samples)
        self._answer_ns = THINKING_NS + 4 * wire_ns(longest, mcu.baud_rate)
        self._sequence = 0
        self._made: tuple[int, int] | None = None
        """Sequence and time of the sealed line just made, until `settle` reports whether it
        left."""
        self._pending: deque[tuple[int, int]] = deque(maxlen=WINDOW)
        """Sequences and times of the lines that left and are not answered."""
        self._knows = False
        self._without = 0
        self._echo = EchoDetector()
        self._begin(fresh=True)

    @property
    def asking(self) -> bool:
        """Whether only questions leave."""
        return self.state in ("waking", "asking")

    @property
    def checked(self) -> bool:
        """Whether only replies with a correct check count."""
        return self.state in ("checked", "sampled")

    @property
    def in_force(self) -> str:
        """The check in force, as text."""
        return IN_FORCE[self.state]

    def begin(self, fresh: bool = False) -> None:
        """Ask from the start and forget all earlier answers.

        `fresh` means that the port has been opened.
        """
        self._sign("gap")
        self._begin(fresh)
        if fresh:
            self.trouble, self._knows, self._question = "", False, b""
            self._echo.forget()

    def _begin(self, fresh: bool) -> None:
        self._pending.clear()
        self._made = None
        self._asked, self._just_asked = Throttle(), False
        self._unanswered, self._open = 0, False
        # The port replaces the first line after an opening by a plain stop.
        self._plain_turn = 0 if fresh else 1

    def _sign(self, sign: Sign) -> None:
        self.state = TABLE.get((self.state, sign), self.state)

    # Lines that leave.

    def seal(self, line: bytes, now_ns: int) -> bytes:
        """Return the line in the form in force."""
        if not self.checked:
            return line
        return self._sealed(line, ASK_SAMPLE if self.state == "sampled" else b"", now_ns)

    def question(self, now_ns: int) -> bytes | None:
        """Return the stop line to send while asking, or None if none is due."""
        waking = self.state == "waking"
        wait_ns = max(BLIND_PERIOD_NS, self._answer_ns) if waking else self._answer_ns
        if not self._asked.lets(now_ns, wait_ns):
            return None
        self._just_asked = True
        self._plain_turn += 1
        if waking and self._plain_turn % 2:
            return self._stop
        letters = self._letters[self._unanswered]
        line = self._sealed(self._stop, letters, now_ns)
        self._question = line.removesuffix(b"\r\n") if letters else b""
        return line

    def left(self, line: bytes) -> None:
        """Note that this line left, with its end."""
        self._echo.left(line)

    def settle(self, went: bool, late_ns: int = 0) -> None:
        """Note whether the last line left, `late_ns` after it was made.

        No answer can come to a line that did not leave.
        """
        if self._made is not None and went:
            sequence, made_ns = self._made
            self._pending.append((sequence, made_ns + late_ns))
            self._open = self.asking
        if self._just_asked and not went:
            self._asked.undo()
            self._plain_turn -= 1
        self._made, self._just_asked = None, False

    def _sealed(self, line: bytes, letters: bytes, now_ns: int) -> bytes:
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._made = (self._sequence, now_ns)
        return seal(line, self._sequence, letters)

    # Lines that come back.

    def echoed(self, line: bytes) -> bool:
        """Return whether this line or an earlier one was an echo of the daemon's own question.

        After an echo no received line is believed until the port is reopened.
        """
        if self._question and line == self._question:
            self.trouble = "echo"
        return self.echoes

    @property
    def echoes(self) -> bool:
        """Whether every received line counts as an echo, until the port is reopened."""
        return self.trouble == "echo"

    def repeated(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Take a report without a sample; return whether it and those before it are an echo."""
        if self._echo.report(line, speeds):
            self.trouble = "echo"
        return self.echoes

    def heard_plain(self) -> None:
        """Note a whole plain line while the daemon asks for the checked link.

        The board is awake, so from now on its silence is an answer too.
        """
        self._sign("heard")

    def answered(self, reply: Checked, at_ns: int) -> int:
        """Take a correct reply; return when the line that it answers left.

        Raises `FrameError` unless the reply answers a line that was sent and is unanswered.
        """
        while self._pending and at_ns - self._pending[0][1] > LATE_NS:
            self._pending.popleft()
        if reply.sequence not in [sequence for sequence, _ in self._pending]:
            raise FrameError("stale_sequence", reply.plain)
        # The board answers lines in order, so the lines before this one get no more answers.
        sequence, left_ns = self._pending.popleft()
        while sequence != reply.sequence:
            sequence, left_ns = self._pending.popleft()
        has_sample = reply.reading is not None
        if self.asking:
            self.settled_ns, self._without = at_ns, 0
            self.trouble, self._knows = "", True
            self._sign("sample" if has_sample else "answer")
            return left_ns
        self._without = 0 if has_sample else self._without + 1
        if self._without >= FEW_SAMPLES:
            self._sign("samples_end")
        return left_ns

    def judge(self, now_ns: int) -> None:
        """Count a question without an answer.

        After the last one accept the plain form or report trouble.
        """
        asked_ns = self._asked.last_ns
        if self.state != "asking" or not self._open or asked_ns is None:
            return
        if self.echoes:
            self._unanswered = 0  # keep asking, so that nothing drives
            return
        if now_ns - asked_ns < self._answer_ns:
            return
        self._open = False
        self._unanswered += 1
        if self._unanswered < len(self._letters):
            return
        self._unanswered = 0
        if self._wanted == "auto" and not self._knows:
            self.settled_ns = now_ns
            self._sign("refusal")
        else:
            self.trouble = "forgotten" if self._knows else "unknown"
