"""Which check is in force on this line: asked at every opening and after every gap, with stops.

    off      mcu.link_check says so: plain lines, nothing is asked
    waking   only stops leave. The MCU has said nothing yet: every other question is a plain stop,
             for it may know no other, and silence is no answer
    asking   only stops leave. The MCU is there, so silence is an answer too
    plain    "auto" only: it answers, but without the check; asked again after the next gap
    checked  a right reply to a line of ours has come; from now on only such count
    sampled  checked, and its replies bring the encoder counts they are asked for

Knows sequences and questions, nothing of speeds. An MCU that has answered with the check once is
never believed without it until the port is opened anew: noise must not talk us out of the check.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from acsard.config.settings import McuConfig
from acsard.config.wire_time import line_bytes, wire_ns
from acsard.mcu.check import ASK_NOTHING, ASK_SAMPLE, SEQUENCES, Checked, seal
from acsard.mcu.codec import FrameError
from acsard.mcu.contract import WATCHDOG_S
from acsard.mcu.throttle import Throttle
from acsard.values import NS_PER_S

State = Literal["off", "waking", "asking", "plain", "checked", "sampled"]
Sign = Literal["gap", "heard", "answer", "sample", "refusal", "samples_end"]
"""What moves it: the link begins anew; a plain line while asking; a right answer to a question,
without or with a sample; no answer to any question; replies that bring no samples any more."""

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
"""Where a sign leads; without an entry it changes nothing."""

IN_FORCE: dict[State, str] = {
    "off": "plain",
    "waking": "being asked for",
    "asking": "being asked for",
    "plain": "plain",
    "checked": "checked",
    "sampled": "checked with samples",
}

Trouble = Literal["", "echo", "forgotten", "unknown"]
"""Why nothing drives however long it is asked: what is sent comes back; the MCU knew the check and
does not answer with it now; it does not know it, and it is required."""

MENDS: dict[Trouble, str] = {
    "": "",
    "echo": "what is sent comes back: TX and RX are joined, or the terminal echoes, or the RS-485 "
    "adapter, or the board reports the speeds it was sent, not those it measures; mend that, then "
    "replug it",
    "forgotten": "the microcontroller answered with a check before and now does not: its replies "
    "are damaged on the way (look at cable and baud rate), or it has other firmware "
    "(then replug it)",
    "unknown": 'the microcontroller answers without a check, and mcu.link_check = "require" drives '
    "only with one: give it firmware that has it, or write "
    'mcu.link_check = "auto"',
}

TRIES = 3
"""Questions of a kind that go unanswered before the MCU is said not to know it."""

WINDOW = 64
"""Lines whose answers may still come; far fewer than the sequence can tell apart."""

LATE_NS = round(WATCHDOG_S * NS_PER_S)
"""An answer later than this is to a line that the MCU's own watchdog has outlived."""

BLIND_PERIOD_NS = NS_PER_S // 10
"""Zero lines go out at 10 Hz while nothing comes back: enough to wake the MCU, little to queue."""

THINKING_NS = 30_000_000
"""What an MCU and the drivers may take to answer, besides the wire."""

FEW_SAMPLES = 5
"""Right replies in a row without the sample they were asked for: it is not coming back."""


class Negotiation:
    """Asks, seals what leaves, and says whether a reply answers a line of ours."""

    def __init__(self, mcu: McuConfig, stop: bytes) -> None:
        """`stop` is the plain stop line."""
        self._stop, self._wanted = stop, mcu.link_check
        self.state: State = "off" if mcu.link_check == "off" else "waking"
        self.trouble: Trouble = ""
        self.settled_ns = 0
        """When asking last ended."""
        first = (ASK_SAMPLE,) * TRIES if mcu.wants_samples else (ASK_NOTHING,)
        self._letters = (*first, *(b"",) * TRIES)
        self._question = b""
        """The last one, if an echo of it can be told from an answer."""
        longest = line_bytes(mcu.trailing_comma, check=True, sample=mcu.wants_samples)
        self._answer_ns = THINKING_NS + 4 * wire_ns(longest, mcu.baud_rate)
        self._sequence = 0
        self._made: tuple[int, int] | None = None
        """Sequence and time of the sealed line just made; what became of it is not known yet."""
        self._pending: deque[tuple[int, int]] = deque(maxlen=WINDOW)
        """Those of the lines that left and are not answered."""
        self._knows = False
        self._without = 0
        self._begin(fresh=True)

    @property
    def asking(self) -> bool:
        """Only `question` leaves."""
        return self.state in ("waking", "asking")

    @property
    def checked(self) -> bool:
        """Only replies with a right check count."""
        return self.state in ("checked", "sampled")

    @property
    def in_force(self) -> str:
        """The check in force, for people."""
        return IN_FORCE[self.state]

    def begin(self, fresh: bool = False) -> None:
        """Ask from the start: nothing said before counts. `fresh` when the port has been opened."""
        self._sign("gap")
        self._begin(fresh)
        if fresh:
            self.trouble, self._knows, self._question = "", False, b""

    def _begin(self, fresh: bool) -> None:
        self._pending.clear()
        self._made = None
        self._asked, self._just_asked = Throttle(), False
        self._unanswered, self._open = 0, False
        # The port makes the first line after an opening a plain stop, whatever it is given.
        self._plain_turn = 0 if fresh else 1

    def _sign(self, sign: Sign) -> None:
        self.state = TABLE.get((self.state, sign), self.state)

    # what leaves

    def seal(self, line: bytes, now_ns: int) -> bytes:
        """The line as it leaves under the check in force."""
        if not self.checked:
            return line
        return self._sealed(line, ASK_SAMPLE if self.state == "sampled" else b"", now_ns)

    def question(self, now_ns: int) -> bytes | None:
        """While asking: the stop that is due now, or None."""
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

    def settle(self, went: bool) -> None:
        """What became of the last line: nobody can answer one that did not go."""
        if self._made is not None and went:
            self._pending.append(self._made)
            self._open = self.asking
        if self._just_asked and not went:
            self._asked.undo()
            self._plain_turn -= 1
        self._made, self._just_asked = None, False

    def _sealed(self, line: bytes, letters: bytes, now_ns: int) -> bytes:
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._made = (self._sequence, now_ns)
        return seal(line, self._sequence, letters)

    # what comes back

    def echoed(self, line: bytes) -> bool:
        """Is this our own question? Then nothing that comes back can be believed: it never is."""
        if self._question and line == self._question:
            self.trouble = "echo"
        return self.echoes

    @property
    def echoes(self) -> bool:
        """Whatever comes is an echo, until the port is opened again."""
        return self.trouble == "echo"

    def found_echo(self) -> None:
        """Plain lines were found to be an echo."""
        self.trouble = "echo"

    def heard_plain(self) -> None:
        """A whole plain line came while asking: the MCU is awake, so silence is an answer too."""
        self._sign("heard")

    def answered(self, reply: Checked, at_ns: int) -> int:
        """Take a right reply; when the line it answers was made.

        Raises `FrameError` unless it answers a line sent and unanswered.
        """
        while self._pending and at_ns - self._pending[0][1] > LATE_NS:
            self._pending.popleft()
        if reply.sequence not in [sequence for sequence, _ in self._pending]:
            raise FrameError("stale_sequence", reply.plain)
        # Lines are answered in order: those before this one will not be any more.
        sequence, made_ns = self._pending.popleft()
        while sequence != reply.sequence:
            sequence, made_ns = self._pending.popleft()
        has_sample = reply.reading is not None
        if self.asking:
            self.settled_ns, self._without = at_ns, 0
            self.trouble, self._knows = "", True
            self._sign("sample" if has_sample else "answer")
            return made_ns
        self._without = 0 if has_sample else self._without + 1
        if self._without >= FEW_SAMPLES:
            self._sign("samples_end")
        return made_ns

    def judge(self, now_ns: int) -> None:
        """Count a question that goes unanswered; after the last one settle for what there is."""
        asked_ns = self._asked.last_ns
        if self.state != "asking" or not self._open or asked_ns is None:
            return
        if self.echoes:
            self._unanswered = 0  # it goes on asking, and nothing drives
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
