"""Negotiates with the board whether lines have a check: a sequence number and a CRC.

This happens when the port is opened, and after a gap. A question is a stop line with the check,
which a board that supports it answers in the same form. Once it has, no plain reply is accepted
until the port is reopened, because noise must not end the check. A question with request letters
that comes back is an echo, because replies have none; `echo_detector.py` detects other echoes.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from acsard.core.codes import Reason, sentence
from acsard.core.config.settings import McuConfig
from acsard.core.config.wire_time import line_bytes, wire_ns
from acsard.core.link.checked_line import (
    ECHO_MARK,
    SAMPLE_REQUEST,
    SEQUENCES,
    Checked,
    has_request,
    seal,
)
from acsard.core.link.codec import FrameError
from acsard.core.link.echo_detector import EchoDetector
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.values import NS_PER_S, Ns, WheelSpeeds

State = Literal["off", "waking", "asking", "plain", "checked", "sampled"]
# gap: the port was opened, or lines were missing or damaged. heard: a plain line, while asking.
# answer, sample: a question was answered, without or with a sample; refusal: none was. samples_end:
# replies have no more samples.
Input = Literal["gap", "heard", "answer", "sample", "refusal", "samples_end"]

# off: lines are plain. waking: every second stop is plain, and silence proves nothing. asking: the
# board is awake, so silence is a no. plain: no check until the next gap ("auto"). checked, sampled:
# only checked replies count, with counts in the latter. A missing pair changes nothing.
TRANSITIONS: dict[tuple[State, Input], State] = {
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

IN_FORCE: dict[State, str] = {
    "off": "plain",
    "waking": "not checked yet",
    "asking": "not checked yet",
    "plain": "plain",
    "checked": "checked",
    "sampled": "checked with samples",
}

# Why no reply is accepted: echo; forgotten (it has answered with a checksum, but no longer does);
# unknown (no checksum, but the configuration requires it).
Trouble = Literal["", "echo", "forgotten", "unknown"]

TROUBLES: dict[Trouble, Reason] = {
    "echo": sentence("echo"),
    "forgotten": sentence("checksum_lost"),
    "unknown": sentence("no_checksum"),
}

# Questions of one kind, until it is given up: those for a sample first, then without one. If no
# samples are wanted, one with `ECHO_MARK` comes first.
MAX_UNANSWERED_QUESTIONS = 3

# That wait for an answer, far below 256 numbers: no reply can match the wrong line.
MAX_OPEN_LINES = 64

# Later answers are rejected; a board without lines stops the motors then.
ANSWER_TIMEOUT_NS = round(WATCHDOG_S * NS_PER_S)

# Period of stops to a silent board: enough to wake it, and few collect in buffers.
SILENT_BOARD_PERIOD_NS = NS_PER_S // 10

PROCESSING_NS = 30_000_000  # for board and drivers, beside the time on the wire

MAX_REPLIES_WITHOUT_SAMPLE = 5  # in a row, until samples are no longer asked for


class Throttle:
    """Allows an event only some time after the last one."""

    def __init__(self) -> None:
        self.last_ns: Ns | None = None
        self._before_ns: Ns | None = None

    def lets(self, now_ns: Ns, wait_ns: Ns) -> bool:
        """Return whether an event is allowed, `wait_ns` after the last one; if so, record it."""
        if self.last_ns is not None and now_ns - self.last_ns < wait_ns:
            return False
        self._before_ns, self.last_ns = self.last_ns, now_ns
        return True

    def undo(self) -> None:
        """Forget the last event, because its line was not written."""
        self.last_ns = self._before_ns


class Negotiation:
    """The negotiation of the check; it also seals commands and finds those of replies."""

    def __init__(self, mcu: McuConfig, stop: bytes) -> None:
        self._stop, self._wanted = stop, mcu.link_check
        self.state: State = "off" if mcu.link_check == "off" else "waking"
        self.trouble: Trouble = ""
        self.settled_ns = 0  # the last negotiation ended
        first = (SAMPLE_REQUEST,) * MAX_UNANSWERED_QUESTIONS if mcu.wants_samples else (ECHO_MARK,)
        self._letters = (*first, *(b"",) * MAX_UNANSWERED_QUESTIONS)
        longest = line_bytes(mcu.trailing_comma, check=True, sample=mcu.wants_samples)
        self._answer_ns = PROCESSING_NS + 4 * wire_ns(longest, mcu.baud_rate)
        self._sequence = 0
        self._made: tuple[int, int] | None = None  # number and time of a line, until `settle`
        self._pending: deque[tuple[int, int]] = deque(maxlen=MAX_OPEN_LINES)  # without an answer
        self._knows = False
        self._without = 0
        self._echo = EchoDetector()
        self._begin(fresh=True)

    @property
    def asking(self) -> bool:
        """Whether the daemon still asks for checksums. Meanwhile it sends only stops."""
        return self.state in ("waking", "asking")

    @property
    def checked(self) -> bool:
        """Whether the daemon accepts only replies with a correct checksum."""
        return self.state in ("checked", "sampled")

    @property
    def in_force(self) -> str:
        """The present form of the lines, in words, such as "checked"."""
        return IN_FORCE[self.state]

    def begin(self, fresh: bool = False) -> None:
        """Start the negotiation again; `fresh`: another board may be connected now."""
        self._apply("gap")
        self._begin(fresh)
        if fresh:
            self.trouble, self._knows = "", False
            self._echo.forget()

    def _begin(self, fresh: bool) -> None:
        self._pending.clear()
        self._made = None
        self._asked, self._just_asked = Throttle(), False
        self._unanswered, self._open = 0, False
        # The port replaces the first line after an opening with a plain stop.
        self._plain_turn = 0 if fresh else 1

    def _apply(self, trigger: Input) -> None:
        self.state = TRANSITIONS.get((self.state, trigger), self.state)

    # Lines to the board.

    def seal(self, line: bytes, now_ns: Ns) -> bytes:
        """Return a plain command in the form that is in force now."""
        if not self.checked:
            return line
        return self._sealed(line, SAMPLE_REQUEST if self.state == "sampled" else b"", now_ns)

    def question(self, now_ns: Ns) -> bytes | None:
        """Return the next line of the negotiation, instead of `seal`, or None if none is due."""
        waking = self.state == "waking"
        wait_ns = max(SILENT_BOARD_PERIOD_NS, self._answer_ns) if waking else self._answer_ns
        if not self._asked.lets(now_ns, wait_ns):
            return None
        self._just_asked = True
        self._plain_turn += 1
        if waking and self._plain_turn % 2:
            return self._stop
        letters = self._letters[self._unanswered]
        return self._sealed(self._stop, letters, now_ns)

    def written(self, line: bytes) -> None:
        """Record a line, with its end, that was written, to detect its echo."""
        self._echo.written(line)

    def settle(self, was_written: bool, late_ns: Ns = 0) -> None:
        """Record whether the last result of `seal` or `question` was written, and how late."""
        if self._made is not None and was_written:
            sequence, made_ns = self._made
            self._pending.append((sequence, made_ns + late_ns))
            self._open = self.asking
        if self._just_asked and not was_written:
            self._asked.undo()
            self._plain_turn -= 1
        self._made, self._just_asked = None, False

    def _sealed(self, line: bytes, letters: bytes, now_ns: Ns) -> bytes:
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._made = (self._sequence, now_ns)
        return seal(line, self._sequence, letters)

    # Lines from the board.

    def check_question_echo(self, line: bytes) -> bool:
        """Return whether this line (without end) or an earlier one is an echo of the daemon's.

        Then every line is rejected until the port is reopened.
        """
        if has_request(line):
            self.trouble = "echo"
        return self.echoes

    @property
    def echoes(self) -> bool:
        return self.trouble == "echo"

    def check_reply_echo(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Process a reply without a sample (no line end); return whether replies are an echo."""
        if self._echo.report(line, speeds):
            self.trouble = "echo"
        return self.echoes

    def record_plain_reply(self) -> None:
        """Record a valid plain line while asking: the board is awake, so silence counts now."""
        self._apply("heard")

    def answered(self, reply: Checked, at_ns: Ns) -> int:
        """Return when the command of a correct checked reply was written.

        Raises `FrameError` if its number belongs to no command of the last `ANSWER_TIMEOUT_NS`.
        """
        while self._pending and at_ns - self._pending[0][1] > ANSWER_TIMEOUT_NS:
            self._pending.popleft()
        if reply.sequence not in [sequence for sequence, _ in self._pending]:
            raise FrameError("stale_sequence", reply.plain)
        # The board answers in order, so earlier lines get no more answers.
        sequence, left_ns = self._pending.popleft()
        while sequence != reply.sequence:
            sequence, left_ns = self._pending.popleft()
        has_sample = reply.reading is not None
        if self.asking:
            self.settled_ns, self._without = at_ns, 0
            self.trouble, self._knows = "", True
            self._apply("sample" if has_sample else "answer")
            return left_ns
        self._without = 0 if has_sample else self._without + 1
        if self._without >= MAX_REPLIES_WITHOUT_SAMPLE:
            self._apply("samples_end")
        return left_ns

    def judge(self, now_ns: Ns) -> None:
        """Count the last question as unanswered if its answer is overdue.

        If all are, plain lines are accepted with "auto", unless the board has ever answered with
        the check. Otherwise this sets `trouble`, and the daemon asks again.
        """
        asked_ns = self._asked.last_ns
        if self.state != "asking" or not self._open or asked_ns is None:
            return
        if self.echoes:
            self._unanswered = 0  # the daemon keeps asking, so that the robot cannot drive
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
            self._apply("refusal")
        else:
            self.trouble = "forgotten" if self._knows else "unknown"
