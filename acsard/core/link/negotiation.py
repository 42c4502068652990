"""Negotiates with the board whether lines have a check: a sequence number and a CRC.

The negotiation runs when the port is opened, and again after a gap in the lines. The daemon asks
with a question, which is a stop line with the check (`checked_line.py`). A board that supports the
check answers in the same form. The states of the negotiation are:

- off: mcu.link_check is "off". Lines are plain, and the daemon does not ask for the check.
- waking: the daemon sends only stops. The board has not answered yet, so its silence proves
  nothing. Every second stop is plain, because the board may support only plain lines.
- asking: the daemon sends only stops. The board has sent a plain line, so it is awake. If it does
  not answer a question now, it probably does not support the check.
- plain: only with mcu.link_check = "auto". The board answers, but without the check. The daemon
  asks again after the next gap.
- checked: the board has answered a question correctly. Now the daemon accepts only checked replies.
- sampled: the same as checked, but each line also asks for the encoder counts, and the replies
  contain them.

Once a board has answered with the check, the daemon accepts no plain replies until the port is
reopened, because noise must not end the check.

The module also detects echoes, which are lines of the daemon that come back because TX and RX are
connected or the far end echoes. If a question with request letters comes back, the echo is detected
immediately, because replies contain no request letters. `echo_detector.py` detects the echo of
plain lines, and of checked lines that ask for no sample.
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
from acsard.core.values import NS_PER_S, WheelSpeeds

State = Literal["off", "waking", "asking", "plain", "checked", "sampled"]
Input = Literal["gap", "heard", "answer", "sample", "refusal", "samples_end"]
"""The inputs of the state machine that negotiates the check: a sequence number and a CRC in each
line. A question is a stop line that asks for the check.

- gap: the negotiation starts again, because the port was opened or lines were missing or damaged
- heard: a plain line came while the daemon was asking for the check
- answer: the board answered a question correctly, without a sample
- sample: the board answered a question correctly, with a sample
- refusal: the board answered none of the questions
- samples_end: the replies no longer contain samples
"""

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
"""Maps each pair of a state and an input (`Input`) to the next state. A pair without an entry does
not change the state."""

IN_FORCE: dict[State, str] = {
    "off": "plain",
    "waking": "not checked yet",
    "asking": "not checked yet",
    "plain": "plain",
    "checked": "checked",
    "sampled": "checked with samples",
}

Trouble = Literal["", "echo", "forgotten", "unknown"]
"""The reason why the daemon accepts no reply, so that the robot cannot drive; else "".

- echo: the lines that the daemon sends come back
- forgotten: the board has answered with a checksum since the port was opened, but no longer does
- unknown: the board does not support checksums, and the configuration requires them
"""

TROUBLES: dict[Trouble, Reason] = {
    "echo": sentence("echo"),
    "forgotten": sentence("checksum_lost"),
    "unknown": sentence("no_checksum"),
}

MAX_UNANSWERED_QUESTIONS = 3
"""Number of questions of one kind after which the daemon gives this kind up, if the board has
answered none of them. A question is a stop line with a sequence number and a checksum. Questions of
the first kind ask for a sample of the encoders, and those of the second kind do not. If the daemon
wants no samples, it sends a single question with `ECHO_MARK` instead of the first kind."""

MAX_OPEN_LINES = 64
"""Largest number of written lines whose answers the daemon waits for. It is far below the number of
sequence numbers (256), so a reply cannot match the wrong line."""

ANSWER_TIMEOUT_NS = round(WATCHDOG_S * NS_PER_S)
"""Longest time from the writing of a command to its answer, ns. Later answers are rejected. If the
board receives no line for the same time, it stops the motors."""

SILENT_BOARD_PERIOD_NS = NS_PER_S // 10
"""Least time between two stop lines while the board sends nothing, ns. A rate of 10 Hz is enough to
wake the board, and only few lines then accumulate in buffers."""

PROCESSING_NS = 30_000_000
"""Time that the board and the drivers may need for an answer in addition to the time on the wire,
ns."""

MAX_REPLIES_WITHOUT_SAMPLE = 5
"""If this many correct replies in a row contain no sample, the daemon stops asking for samples."""


class Throttle:
    """A rate limiter. After an allowed event, the next event must wait for a given time."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self._before_ns: int | None = None

    def lets(self, now_ns: int, wait_ns: int) -> bool:
        """Return whether an event is allowed at `now_ns`, and record the event if it is.

        An event is allowed if the last one was at least `wait_ns` ns earlier, or if there was none.
        """
        if self.last_ns is not None and now_ns - self.last_ns < wait_ns:
            return False
        self._before_ns, self.last_ns = self.last_ns, now_ns
        return True

    def undo(self) -> None:
        """Forget the last allowed event, because the line for which it was allowed was not written.

        The next event is then allowed immediately.
        """
        self.last_ns = self._before_ns


class Negotiation:
    """The negotiation of the check (a sequence number and a CRC in each line) with the board.

    The class also adds the check to commands, and finds the command that a reply answers.
    """

    def __init__(self, mcu: McuConfig, stop: bytes) -> None:
        """Start before the first question to the board.

        `stop` is the plain line that commands speed zero for all wheels.
        """
        self._stop, self._wanted = stop, mcu.link_check
        self.state: State = "off" if mcu.link_check == "off" else "waking"
        self.trouble: Trouble = ""
        self.settled_ns = 0
        """Monotonic time at which the last negotiation ended, ns."""
        first = (SAMPLE_REQUEST,) * MAX_UNANSWERED_QUESTIONS if mcu.wants_samples else (ECHO_MARK,)
        self._letters = (*first, *(b"",) * MAX_UNANSWERED_QUESTIONS)
        longest = line_bytes(mcu.trailing_comma, check=True, sample=mcu.wants_samples)
        self._answer_ns = PROCESSING_NS + 4 * wire_ns(longest, mcu.baud_rate)
        self._sequence = 0
        self._made: tuple[int, int] | None = None
        """A pair: the sequence number of the last checked line, and the monotonic time at which it
        was made, ns. None once `settle` has recorded whether the line was written."""
        self._pending: deque[tuple[int, int]] = deque(maxlen=MAX_OPEN_LINES)
        """The written checked lines that are not answered yet, oldest first. Each is a pair of its
        sequence number and the monotonic time at which it was written, ns."""
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
        """Start the negotiation again, after the port was opened or lines were missing or damaged.

        If `fresh` is true, also forget all facts about the board, because another board may be
        connected now.
        """
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
        # The port replaces the first line after an opening with a plain stop, so the first line is
        # a plain stop here too.
        self._plain_turn = 0 if fresh else 1

    def _apply(self, trigger: Input) -> None:
        self.state = TRANSITIONS.get((self.state, trigger), self.state)

    # Lines to the board.

    def seal(self, line: bytes, now_ns: int) -> bytes:
        """Return a plain command in the form that is in force now, plain or checked.

        `line` is the plain command. `now_ns` is the monotonic time at which the command is made.
        """
        if not self.checked:
            return line
        return self._sealed(line, SAMPLE_REQUEST if self.state == "sampled" else b"", now_ns)

    def question(self, now_ns: int) -> bytes | None:
        """Return the next line of the negotiation, or None if no line is due yet.

        The line is a plain stop, or a question: a stop line with a sequence number and a CRC. The
        caller calls this method instead of `seal` while the daemon asks for the check. `now_ns` is
        the monotonic time at which the line is made.
        """
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
        """Record that `line`, with its line end, was written to the port, to detect its echo."""
        self._echo.written(line)

    def settle(self, was_written: bool, late_ns: int = 0) -> None:
        """Record whether the port wrote the line that `seal` or `question` returned last.

        `was_written` is true if the port wrote this line. `late_ns` is the time from the making to
        the writing of the line, ns.
        """
        if self._made is not None and was_written:
            sequence, made_ns = self._made
            self._pending.append((sequence, made_ns + late_ns))
            self._open = self.asking
        if self._just_asked and not was_written:
            self._asked.undo()
            self._plain_turn -= 1
        self._made, self._just_asked = None, False

    def _sealed(self, line: bytes, letters: bytes, now_ns: int) -> bytes:
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._made = (self._sequence, now_ns)
        return seal(line, self._sequence, letters)

    # Lines from the board.

    def check_question_echo(self, line: bytes) -> bool:
        """Return whether this line or an earlier one is an echo of a line of the daemon.

        `line` is without its line end. After an echo, the caller rejects every received line until
        the port is reopened.
        """
        if has_request(line):
            self.trouble = "echo"
        return self.echoes

    @property
    def echoes(self) -> bool:
        """Whether an echo was detected. Then all lines are rejected until the port is reopened."""
        return self.trouble == "echo"

    def check_reply_echo(self, line: bytes, speeds: WheelSpeeds) -> bool:
        """Process a reply without a sample, and return whether the last replies are an echo.

        `line` is the reply without its line end, and `speeds` are the speeds in the reply.
        """
        if self._echo.report(line, speeds):
            self.trouble = "echo"
        return self.echoes

    def record_plain_reply(self) -> None:
        """Record that a valid plain line came while the daemon was asking for checked lines.

        This line shows that the board is awake, so unanswered requests are counted from now on.
        """
        self._apply("heard")

    def answered(self, reply: Checked, at_ns: int) -> int:
        """Process a correct checked reply, and return the time at which its command was written.

        This time is monotonic, in ns. `at_ns` is the monotonic time at which the reply was read.
        Raises `FrameError` if the sequence number of the reply does not belong to a command that
        waits for an answer. A command waits for at most 0.3 s (`ANSWER_TIMEOUT_NS`).
        """
        while self._pending and at_ns - self._pending[0][1] > ANSWER_TIMEOUT_NS:
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
            self._apply("sample" if has_sample else "answer")
            return left_ns
        self._without = 0 if has_sample else self._without + 1
        if self._without >= MAX_REPLIES_WITHOUT_SAMPLE:
            self._apply("samples_end")
        return left_ns

    def judge(self, now_ns: int) -> None:
        """Count the last question as unanswered if its answer is overdue.

        A question is a stop line that asks for the check: a sequence number and a CRC. If the board
        has answered none of the questions, there are two cases:

        - `mcu.link_check` is "auto", and the board has never answered with the check: the daemon
          accepts plain lines.
        - Otherwise the method sets `trouble`, and the daemon asks again.

        `now_ns` is monotonic.
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
